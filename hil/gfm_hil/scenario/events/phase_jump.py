"""The grid's angle."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent


class PhaseJump(GridEvent):
    """The grid's angle jumps ahead by ``degrees``."""

    type: Literal["grid-phase-jump"] = Field(description="kind of event")
    degrees: float = Field(ge=-180, le=180, description="by which the grid's angle jumps ahead")

    def label(self) -> str:
        return f"phase jump {self.degrees:g}°"

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.phase_jump(plant, self.degrees)
