"""The load of a finite grid."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent
from gfm_plant.names import THE_GRID


class GridLoad(GridEvent):
    """The load of a finite grid changes by ``change`` [p.u. of the grid's rating]."""

    type: Literal["grid-load"] = Field(description="kind of event")
    change: float = Field(ge=-2, le=2, description="p.u. of the rating of the finite grid")

    def label(self) -> str:
        return f"grid load {self.change:+g} p.u."

    def acts_on(self) -> str | None:
        return THE_GRID

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.grid_load(plant, self.change)
