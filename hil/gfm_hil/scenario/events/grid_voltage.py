"""The grid's voltage."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent


class GridVoltage(GridEvent):
    """Grid voltage [p.u.]: a step, a ramp at ``rate`` [p.u./s], or a sag of ``duration`` [s]."""

    type: Literal["grid-voltage"] = Field(description="kind of event")
    V_g: float = Field(ge=0, le=1.5, description="p.u.")
    rate: float | None = Field(None, gt=0, description="p.u./s; a step if none")
    duration: float | None = Field(None, gt=0, description="s; then the voltage returns (a sag)")

    @model_validator(mode="after")
    def _ramp_or_sag(self) -> GridVoltage:
        if self.rate is not None and self.duration is not None:
            raise ValueError(f"rate = {self.rate}, duration = {self.duration}: a ramp or a sag")
        return self

    def label(self) -> str:
        return f"grid {self.V_g:g} p.u." + (f" for {self.duration:g} s" if self.duration else "")

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.grid_voltage(plant, self.V_g, self.rate, self.duration)
