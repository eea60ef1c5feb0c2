"""The impedance of the line to the grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario


class GridImpedance(GridEvent):
    """The line becomes ``L_g`` and ``R_g`` times its nominal elements, or one of a short-circuit
    ratio ``scr`` with ``x_over_r``, as ``plant.grid`` has them."""

    type: Literal["grid-impedance"] = Field(description="kind of event")
    L_g: float | None = Field(
        None, gt=0, le=1e12, description="factor on the converter file's line inductor"
    )
    R_g: float | None = Field(
        None, ge=0, le=1e12, description="factor on the converter file's line resistor"
    )
    scr: float | None = Field(
        None, gt=0, le=1e6, description="short-circuit ratio at the point of connection"
    )
    x_over_r: float | None = Field(
        None, gt=0, le=1e6, description="X/R of the line at nominal frequency; goes with scr"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> GridImpedance:
        names = ("L_g", "R_g", "scr", "x_over_r")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["L_g", "R_g"], ["scr", "x_over_r"]):
            raise ValueError(
                f"{', '.join(given) or 'nothing'} given: give L_g and R_g, or scr and x_over_r"
            )
        return self

    def factors(self, plant: gfm_plant.Network) -> tuple[float, float]:
        """Of the line's nominal L and R. Raises ValueError: the converter's line has no resistance
        that a factor could change."""
        if self.L_g is not None and self.R_g is not None:
            return self.L_g, self.R_g
        from gfm_plant.options import Grid

        line, r = Grid(scr=self.scr, x_over_r=self.x_over_r).line(), plant.par[0]
        assert line is not None
        if r["R_line_n"] == 0.0:
            raise ValueError(f"x_over_r = {self.x_over_r}: needs a converter file with R_g > 0")
        return line["L_g"] / float(r["L_line_n"]), line["R_g"] / float(r["R_line_n"])

    def label(self) -> str:
        if self.scr is not None:
            return f"SCR {self.scr:g}, X/R {self.x_over_r:g}"
        return f"line L × {self.L_g:g}, R × {self.R_g:g}"

    def misfits(self, scenario: Scenario) -> list[str]:
        if scenario.network is None:
            return []
        return [
            "grid-impedance is for the line of one converter alone; a network's lines have breakers"
        ]

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.grid_impedance(plant, *self.factors(plant))
