"""A line."""

from typing import ClassVar

from pydantic import Field

from gfm_plant.circuit import Branch
from gfm_plant.components.part import Component
from gfm_plant.parameters import NonNegative, Positive


class Line(Component):
    """R and L in series between two nodes of a network."""

    title: ClassVar = "Line"
    symbol: ClassVar = "inductor"
    example: ClassVar = {
        "lines": {"x": {"start": "bus", "end": "n", "L": 0.1}},
        "loads": {"r": {"node": "n", "P": 0.1}},
    }

    start: str = Field(min_length=1, description="node at its start")
    end: str = Field(min_length=1, description="node at its end")
    L: Positive = Field(description="p.u. of the first converter")
    R: NonNegative = Field(0.0, description="p.u. of the first converter")
    closed: bool = Field(True, description="whether its breaker is closed when the run begins")

    def elements(self, name: str) -> tuple[Branch, ...]:
        return (Branch(name, self.start, self.end, self.L, self.R),)

    def label(self) -> str:
        return f"L {self.L:.3g}, R {self.R:.3g} p.u."
