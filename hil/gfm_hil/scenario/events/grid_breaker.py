"""The breaker between the converter and the grid."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

import gfm_plant
from gfm_hil.scenario.events.breaker import Switch

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario


class GridBreaker(Switch):
    """The grid breaker opens onto the local load, or closes again."""

    type: Literal["grid-breaker"] = Field(description="kind of event")
    closed: bool = Field(description="false opens it onto the local load")

    def label(self) -> str:
        return "grid breaker " + ("closes" if self.closed else "opens") + self.when()

    def misfits(self, scenario: Scenario) -> list[str]:
        alone = scenario.plant.grid.load_R is None and not scenario.network
        return ["the breaker needs plant.grid.load_R and load_L"] if alone else []

    def switch(self, plant: gfm_plant.Network) -> None:
        gfm_plant.breaker(plant, self.closed)


EVENT = GridBreaker
