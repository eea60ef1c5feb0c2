"""What the grid behind the line does: frequency, voltage, angle, and the load of a finite grid."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import PlantEvent, nominal_hz
from gfm_plant.names import THE_GRID


class GridFrequency(PlantEvent):
    """Grid frequency: a step, or a ramp at ``rate`` [Hz/s]."""

    type: Literal["grid-frequency"] = Field(description="kind of event")
    f_hz: float = Field(gt=0, le=1000, description="Hz")
    rate: float | None = Field(None, gt=0, description="Hz/s; a step if none")

    def label(self) -> str:
        return f"grid {self.f_hz:g} Hz" + (f" at {self.rate:g} Hz/s" if self.rate else "")

    def apply(self, plant: gfm_plant.Network) -> None:
        f_n = nominal_hz(plant)
        gfm_plant.grid_frequency(plant, self.f_hz / f_n, self.rate / f_n if self.rate else None)


class GridVoltage(PlantEvent):
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


class PhaseJump(PlantEvent):
    """The grid's angle jumps ahead by ``degrees``."""

    type: Literal["grid-phase-jump"] = Field(description="kind of event")
    degrees: float = Field(ge=-180, le=180, description="by which the grid's angle jumps ahead")

    def label(self) -> str:
        return f"phase jump {self.degrees:g}°"

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.phase_jump(plant, self.degrees)


class GridLoad(PlantEvent):
    """The load of a finite grid changes by ``change`` [p.u. of the grid's rating]."""

    type: Literal["grid-load"] = Field(description="kind of event")
    change: float = Field(ge=-2, le=2, description="p.u. of the rating of the finite grid")

    def label(self) -> str:
        return f"grid load {self.change:+g} p.u."

    def acts_on(self) -> str | None:
        return THE_GRID

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.grid_load(plant, self.change)
