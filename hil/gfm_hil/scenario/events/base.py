"""What every event of a scenario has, and what each kind defines.

An event has a time ``t`` [s] or a ``tick``. A field ``law`` names a law that the run makes ready,
``file`` a file that goes with the run, ``converter`` the one converter of a network it is for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from pydantic import Field, model_validator

from gfm_hil.core.roles import Role
from gfm_hil.core.schema import StrictSchema
from gfm_runtime.states import SAFE

if TYPE_CHECKING:
    from gfm_hil.scenario.events.grid_profile import ProfilePoint
    from gfm_hil.scenario.schema import Scenario
    from gfm_plant import Network
    from gfm_runtime.assembly import Controller

#: for the field ``converter``
WHOSE: Any = Field(None, description="in a network: which converter it is for; all of them if none")


def nominal_hz(plant: Network) -> float:
    """Nominal frequency of a plant, Hz."""
    return plant.wiring.omega_b / (2 * math.pi)


class EventTarget(Protocol):
    """What an event acts on: one converter of a run."""

    scenario: Scenario
    plant: Network  # in common with the other converters of a network
    place: int  # the converter's index in it
    controller: Controller

    def reset_controller(self) -> None:
        """Take the controller from SAFE to READY."""


class Event(StrictSchema):
    """One event at its time; each kind adds ``type``, its fields and what it does."""

    side: ClassVar[Role]  # who carries it out
    opens_phases: ClassVar[bool] = False  # whether the plant opens contacts for it, or checks them
    changes_law: ClassVar[bool] = False  # whether it replaces the law in force, or its gains
    if TYPE_CHECKING:
        type: str  # a Literal of each kind

    t: float | None = Field(None, ge=0, le=86400, description="time of the event, s")
    tick: int | None = Field(
        None, ge=0, le=86_400_000_000, description="tick of the event, in place of t"
    )

    @model_validator(mode="after")
    def _one_time(self) -> Event:
        if (self.t is None) == (self.tick is None):
            raise ValueError(f"t = {self.t}, tick = {self.tick}: give one of them")
        return self

    def at(self, T_s: float) -> int:
        """The tick of the event; a time is rounded to the nearest tick."""
        return self.tick if self.tick is not None else round((self.t or 0.0) / T_s)

    def lasts(self) -> float:
        """How long it acts, s, if the event itself says so; 0 for a step and for what stays."""
        return float(getattr(self, "duration", None) or getattr(self, "ramp_s", None) or 0.0)

    def label(self) -> str:
        """What figures and reports call it, in short."""
        raise NotImplementedError

    def label_in(self, target: EventTarget) -> str:
        """``label`` while the loop runs: it reads no file."""
        return self.label()

    def misfits(self, scenario: Scenario) -> list[str]:
        """What keeps the event out of a scenario, a line each; needs no plant and no laws."""
        return []

    def check_now(self, target: EventTarget) -> None:
        """Check, off the loop, that an operator's event can be carried out now. Raises ValueError:
        why not."""

    def carry_out(self, target: EventTarget) -> None:
        """Carry it out between two ticks. Raises ValueError: it is not possible; nothing has
        changed."""
        raise NotImplementedError


class ControllerEvent(Event):
    """An event that changes a controller which runs."""

    side: ClassVar[Role] = "controller"

    def check_now(self, target: EventTarget) -> None:
        if target.controller.ctl["state"][0] == SAFE:
            raise ValueError(
                f"{self.label_in(target)}: the controller is in SAFE, and a reset will bring back "
                "the scenario's law and references; send this after the reset"
            )


class PlantEvent(Event):
    """An event that the plant carries out, by ``apply``."""

    side: ClassVar[Role] = "plant"

    def apply(self, plant: Network) -> None:
        """Change the plant's records, between two ticks. Raises ValueError: it is not possible;
        nothing has changed."""
        raise NotImplementedError

    def acts_on(self) -> str | None:
        """The node or part of a network that it is at; None: what all parts of a plant have."""
        return None

    def try_on(self, plant: Network) -> None:
        """Try the event of a scenario on its plant before the run. Raises UserError, ValueError: it
        is not possible."""
        self.apply(plant)

    def course(self, plant: Network) -> Iterator[tuple[int, ProfilePoint]]:
        """What follows, each with its tick after the event."""
        return iter(())

    def check_now(self, target: EventTarget) -> None:
        self.apply(target.plant.copy())

    def carry_out(self, target: EventTarget) -> None:
        # a plant of several converters changes once, and of its parts only where the event is
        if target.place == 0 and self.acts_on() not in target.plant.elsewhere:
            self.apply(target.plant)


class GridEvent(PlantEvent):
    """An event of the grid, which an island does not have."""
