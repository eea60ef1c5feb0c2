"""A line."""

from collections.abc import Sequence
from typing import ClassVar

from pydantic import Field

from gfm_plant.circuit import Branch, Capacitor, Element
from gfm_plant.components.part import Component
from gfm_plant.parameters import NonNegative, Positive


class Line(Component):
    """R and L in series between two nodes of a network; with charging B, a line or cable as a pi,
    half of B from each node to ground. Its breaker, and a fault inside, are in R and L: the
    charging stays at the nodes. All charging and banks at a node are one capacitor; at the grid's
    node, whose voltage the grid holds, a line has none. The zero sequence has no charging."""

    title: ClassVar = "Line"
    symbol: ClassVar = "inductor"
    example: ClassVar = {
        "lines": {"x": {"start": "bus", "end": "n", "L": 0.1, "B": 0.1}},
        "loads": {"r": {"node": "n", "P": 0.1}},
    }

    start: str = Field(min_length=1, description="node at its start")
    end: str = Field(min_length=1, description="node at its end")
    L: Positive = Field(description="p.u. of the first converter")
    R: NonNegative = Field(0.0, description="p.u. of the first converter")
    B: NonNegative = Field(
        0.0, description="charging, both ends together, p.u. of the first converter"
    )
    closed: bool = Field(True, description="whether its breaker is closed when the run begins")

    def elements(self, name: str) -> Sequence[Element]:
        series = Branch(name, self.start, self.end, self.L, self.R)
        if self.B == 0.0:
            return (series,)
        ends = (("start", self.start), ("end", self.end))
        return series, *(Capacitor(f"{name}.{end}", node, self.B / 2) for end, node in ends)

    def label(self) -> str:
        charging = f", B {self.B:.3g}" if self.B else ""
        return f"L {self.L:.3g}, R {self.R:.3g}{charging} p.u."
