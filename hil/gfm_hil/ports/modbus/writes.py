"""The effect of a write: commands, and the state to store once they were carried out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from gfm_hil.ports.modbus.image import Value
from gfm_hil.ports.modbus.run_state import RunState


@dataclass(frozen=True)
class Effect:
    """Commands for the run, in order. The device calls ``keep`` once all of them were carried out,
    or ``fail`` if one was refused."""

    events: tuple[dict[str, Any], ...] = ()
    keep: Callable[[], None] = lambda: None
    fail: Callable[[], None] = lambda: None


class PointGroup(Protocol):
    """A group of points that clients write together and that have a common meaning.

    ``plan`` computes the effect of a write without applying it; it raises ValueError for invalid
    values.
    """

    @property
    def writable(self) -> tuple[str, ...]:
        """Paths of the points that clients may write."""

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
        """The effect of writing these values at the device's time ``now``, s."""

    def forget(self) -> None:
        """Clear the state, if any: the run was reset, or another operator commands it."""
        return

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        """The values of its points."""
