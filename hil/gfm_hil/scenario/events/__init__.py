"""The events of a scenario, one file each: its fields, its checks and what it does.

A new kind is a file with ``EVENT`` and its name in ``FILES``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Union, get_args

from pydantic import Field

from gfm_hil.scenario.events.base import Event

#: of this folder, in the order in which the documentation lists the kinds
FILES = (
    "reference",
    "law",
    "gains",
    "reset",
    "grid_frequency",
    "grid_voltage",
    "grid_profile",
    "phase_jump",
    "grid_impedance",
    "grid_load",
    "grid_unbalance",
    "fault",
    "fault_clear",
    "grid_breaker",
    "breaker",
)
_KINDS: tuple[type[Event], ...] = tuple(import_module(f"{__name__}.{f}").EVENT for f in FILES)

EVENTS = {get_args(kind.model_fields["type"].annotation)[0]: kind for kind in _KINDS}
"""The kinds of events by what ``type`` says in a scenario."""

if TYPE_CHECKING:
    AnyEvent = Event
else:
    AnyEvent = Annotated[Union[_KINDS], Field(discriminator="type")]  # noqa: UP007
