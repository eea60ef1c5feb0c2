"""Return from a trip or the safe state."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from gfm_hil.core.roles import Role
from gfm_hil.scenario.events.base import WHOSE, Event, EventTarget

if TYPE_CHECKING:
    from gfm_hil.scenario.schema import Scenario


class Reset(Event):
    """Return from a trip or the safe state to the scenario's start, for runs that wait there. A
    converter of a network starts again in the network as it is by then."""

    side: ClassVar[Role] = "controller"
    type: Literal["reset"] = Field(description="kind of event")
    converter: str | None = WHOSE

    def label(self) -> str:
        return "reset"

    def misfits(self, scenario: Scenario) -> list[str]:
        wrong = scenario.after_trip == "end"
        return ["nothing to reset with after_trip = 'end'; use 'wait'"] if wrong else []

    def check_now(self, target: EventTarget) -> None:
        if target.scenario.after_trip == "end":
            raise ValueError("reset: this run ends at a trip; after_trip = 'wait' in its scenario")

    def carry_out(self, target: EventTarget) -> None:
        target.reset_controller()
