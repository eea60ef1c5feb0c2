"""The end of a fault."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.base import PlantEvent


class FaultClear(PlantEvent):
    """The fault is cleared."""

    type: Literal["fault-clear"] = Field(description="kind of event")

    def label(self) -> str:
        return "fault cleared"

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.clear_fault(plant)


EVENT = FaultClear
