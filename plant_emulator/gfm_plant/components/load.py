"""A load of resistance and inductance."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field, model_validator

from gfm_plant.circuit import GROUND, Branch, Shunt
from gfm_plant.components.part import Component
from gfm_plant.parameters import NonNegative


class Load(Component):
    """A load between a node and ground: R and L in series that draw P and Q at nominal voltage and
    frequency; without Q a resistor."""

    title: ClassVar = "Load: R and L in series, or a resistor"
    symbol: ClassVar = "load"
    example: ClassVar = {"loads": {"x": {"node": "bus", "P": 0.1, "Q": 0.1}}}

    node: str = Field(min_length=1, description="where it is")
    P: NonNegative = Field(
        description="active power at nominal voltage, p.u. of the first converter"
    )
    Q: NonNegative = Field(
        0.0, description="reactive power at nominal voltage, p.u. of the first converter"
    )
    closed: bool = Field(True, description="whether its breaker is closed when the run begins")

    @model_validator(mode="after")
    def _draws_something(self) -> Load:
        if self.P == self.Q == 0.0:
            raise ValueError("P = 0, Q = 0: must draw something")
        return self

    def elements(self, name: str) -> tuple[Branch | Shunt]:
        size = self.P**2 + self.Q**2
        if self.Q > 0:
            return (Branch(name, self.node, GROUND, self.Q / size, self.P / size),)
        return (Shunt(name, self.node, 1 / self.P),)

    def label(self) -> str:
        return f"P {self.P:.4g}, Q {self.Q:.4g} p.u."
