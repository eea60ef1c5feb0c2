"""The grid's frequency."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent, nominal_hz


class GridFrequency(GridEvent):
    """Grid frequency: a step, or a ramp at ``rate`` [Hz/s]."""

    type: Literal["grid-frequency"] = Field(description="kind of event")
    f_hz: float = Field(gt=0, le=1000, description="Hz")
    rate: float | None = Field(None, gt=0, description="Hz/s; a step if none")

    def label(self) -> str:
        return f"grid {self.f_hz:g} Hz" + (f" at {self.rate:g} Hz/s" if self.rate else "")

    def apply(self, plant: gfm_plant.Network) -> None:
        f_n = nominal_hz(plant)
        gfm_plant.grid_frequency(plant, self.f_hz / f_n, self.rate / f_n if self.rate else None)
