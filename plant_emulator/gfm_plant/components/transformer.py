"""A transformer."""

from typing import ClassVar, Literal

from pydantic import Field

from gfm_plant.circuit import GROUND, Branch
from gfm_plant.components.part import Component
from gfm_plant.parameters import NonNegative, Positive


class Transformer(Component):
    """A transformer between two nodes: its leakage in series, and its magnetising inductance from
    the start to ground. Its ratio is that of the nominal voltages, but for taps in ``ratio``; the
    angle by which a delta winding turns all voltages is left out, and it does not saturate. For a
    zero sequence the earthed star point of one side, with a delta on the other, is a path to ground
    through the leakage."""

    title: ClassVar = "Transformer"
    symbol: ClassVar = "windings"
    example: ClassVar = {
        "transformers": {"x": {"start": "bus", "end": "n", "S": 1.0, "X": 0.1, "X_m": 50.0}},
        "loads": {"r": {"node": "n", "P": 0.1}},
    }

    start: str = Field(min_length=1, description="node at its start, such as the converter's side")
    end: str = Field(min_length=1, description="node at its end")
    S: Positive = Field(description="rating over that of the first converter")
    X: Positive = Field(description="leakage reactance, p.u. of its rating")
    R: NonNegative = Field(0.0, description="resistance, p.u. of its rating")
    X_m: Positive | None = Field(
        None, description="magnetising reactance, p.u. of its rating; none: no magnetising current"
    )
    ratio: Positive = Field(
        1.0,
        description="voltage of its start over that of its end without load, p.u.: the position of "
        "its taps",
    )
    earthed: Literal["end", "start", "both", "none"] = Field(
        "end",
        description="where its star points are earthed; the other winding is a delta, and with "
        "both a zero sequence passes through",
    )
    closed: bool = Field(True, description="whether its breaker is closed when the run begins")

    def elements(self, name: str) -> list[Branch]:
        leakage = Branch(
            name, self.start, self.end, self.X / self.S, self.R / self.S, self.earthed,
            ratio=self.ratio,
        )  # fmt: skip
        if self.X_m is None:
            return [leakage]
        X_m = self.X_m / self.S
        return [leakage, Branch(f"{name}.m", self.start, GROUND, X_m, 0.0, switched=False)]

    def label(self) -> str:
        text = f"S {self.S:.4g}, X {self.X:.3g}, R {self.R:.2g}"
        text += f", ratio {self.ratio:.4g}" * (self.ratio != 1.0)
        return text if self.X_m is None else f"{text}, $X_m$ {self.X_m:g}"
