"""The breakers of the grid and of a network, and the synchro-check that lets one close."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.core.schema import StrictSchema
from gfm_hil.scenario.events.base import GridEvent, PlantEvent, nominal_hz
from gfm_plant.names import THE_GRID

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario


_WORDS = {"on": True, "off": False, "closes": True, "opens": False}  # with which a label ends


class SynchroCheck(StrictSchema):
    """When a breaker may close: its two sides must agree for a time. The defaults are the limits of
    IEEE Std 1547-2018, Table 5, for 1.5 to 10 MVA."""

    V: float = Field(0.03, gt=0, le=1, description="largest difference of the voltages, p.u.")
    f_hz: float = Field(0.1, gt=0, le=10, description="of the frequencies, Hz")
    degrees: float = Field(10.0, gt=0, le=180, description="of the angles")
    lasting_s: float = Field(
        0.1, ge=0, le=3600, description="for how long all three must stay within, s"
    )
    within_s: float = Field(
        60.0, gt=0, le=86400, description="after this time the breaker stays open, s"
    )

    @model_validator(mode="after")
    def _has_the_time(self) -> SynchroCheck:
        if self.within_s <= self.lasting_s:
            raise ValueError(
                f"within_s = {self.within_s:g}: must be more than lasting_s = {self.lasting_s:g}"
            )
        return self


class Switch(PlantEvent):
    """A breaker: that of the grid, or one with a ``name``."""

    opens_phases = True

    closed: bool = Field(description="false opens it")
    check: SynchroCheck | None = Field(
        None, description="closes once both sides agree, by a synchro-check; at once if none"
    )

    clearing: Literal["zero", "instant"] = Field(
        "zero",
        description="of one that opens; zero: each pole opens where its current next passes zero; "
        "instant: all poles open at once",
    )

    @model_validator(mode="after")
    def _goes_with_the_direction(self) -> Switch:
        if self.check is not None and not self.closed:
            raise ValueError("check: goes with closed = true")
        if self.closed and self.clearing == "instant":
            raise ValueError("clearing = 'instant': goes with closed = false")
        return self

    def when(self) -> str:
        """The end of its label."""
        return "" if self.check is None else " when synchronous"

    def switch(self, plant: gfm_plant.Network) -> None:
        """Begin to open, as ``clearing`` says, or close."""
        raise NotImplementedError

    def apply(self, plant: gfm_plant.Network) -> None:
        by = self.check
        if by is None:
            self.switch(plant)
            return
        name, f_hz = getattr(self, "name", ""), by.f_hz / nominal_hz(plant)
        limits = by.V, f_hz, by.degrees, by.lasting_s, by.within_s
        gfm_plant.check_synchronism(plant, name, *limits)

    def try_on(self, plant: gfm_plant.Network) -> None:
        from gfm_plant.synchro_check import AGREED

        self.apply(plant)
        if self.check is not None:  # what it waits for is tried too
            plant.now["check"] = AGREED
            gfm_plant.finish_check(plant)


class LineBreaker(Switch):
    """The breaker of a line or load of a network opens or closes."""

    type: Literal["breaker"] = Field(description="kind of event")
    name: str = Field(
        min_length=1, description="of the line or load, or of the converter whose line it is"
    )

    def label(self) -> str:
        return f"{self.name} " + ("on" if self.closed else "off") + self.when()

    def acts_on(self) -> str | None:
        return self.name

    def switch(self, plant: gfm_plant.Network) -> None:
        gfm_plant.line_breaker(plant, self.name, self.closed, self.clearing)


GRID = "grid"  # what `switched` calls the breaker of the grid


def switched(line: Mapping[str, Any]) -> tuple[str, bool] | None:
    """The part whose breaker a line of a run's log has switched, and whether it is closed now, by
    the words of ``label`` and of the end of a synchro-check; None of any other line."""
    if line.get("event", line.get("type")) not in ("breaker", "grid-breaker"):
        return None
    label = str(line.get("label", "")).removesuffix(", synchronous")
    name, _, word = label.rpartition(" ")
    if "refused" in line or word not in _WORDS:
        return None
    return (GRID if name == "grid breaker" else name), _WORDS[word]


class GridBreaker(Switch, GridEvent):
    """The grid breaker opens onto the local load, or closes again."""

    type: Literal["grid-breaker"] = Field(description="kind of event")
    closed: bool = Field(description="false opens it onto the local load")

    def label(self) -> str:
        return "grid breaker " + ("closes" if self.closed else "opens") + self.when()

    def misfits(self, scenario: Scenario) -> list[str]:
        alone = scenario.plant.grid.load_R is None and not scenario.network
        return ["the breaker needs plant.grid.load_R and load_L"] if alone else []

    def acts_on(self) -> str | None:
        return THE_GRID

    def switch(self, plant: gfm_plant.Network) -> None:
        gfm_plant.breaker(plant, self.closed, self.clearing)
