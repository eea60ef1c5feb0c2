"""The irradiance on PV arrays."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.base import WHOSE, EventTarget, PlantEvent


class Irradiance(PlantEvent):
    """Irradiance on PV arrays [of 1000 W/m2]: a step, or a ramp at ``rate`` [1/s]."""

    type: Literal["irradiance"] = Field(description="kind of event")
    irradiance: float = Field(ge=0, le=1.5, description="where it goes, of 1000 W/m2")
    rate: float | None = Field(None, gt=0, le=1e6, description="1/s; a step if none")
    converter: str | None = WHOSE

    def label(self) -> str:
        return f"irradiance {self.irradiance:g}" + (f" at {self.rate:g}/s" if self.rate else "")

    def acts_on(self) -> str | None:
        return self.converter

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.set_irradiance(plant, self.irradiance, self.rate, self.converter)

    def carry_out(self, target: EventTarget) -> None:
        # one for a single converter comes to that one alone
        if self.converter is None:
            super().carry_out(target)
        else:
            self.apply(target.plant)
