"""A bank of capacitors."""

from typing import ClassVar

from pydantic import Field

from gfm_plant.circuit import Capacitor
from gfm_plant.components.part import Component
from gfm_plant.parameters import Positive


class CapacitorBank(Component):
    """Capacitors between a node and ground."""

    title: ClassVar = "Capacitor bank"
    symbol: ClassVar = "capacitor"
    example: ClassVar = {"capacitors": {"x": {"node": "bus", "Q": 0.1}}}

    node: str = Field(min_length=1, description="where it is")
    Q: Positive = Field(
        description="reactive power at nominal voltage, p.u. of the first converter"
    )

    def elements(self, name: str) -> tuple[Capacitor]:
        return (Capacitor(name, self.node, self.Q),)

    def label(self) -> str:
        return f"Q {self.Q:.4g} p.u."
