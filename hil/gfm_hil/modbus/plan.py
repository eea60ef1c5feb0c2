"""What a write comes to: commands, and what is to be remembered once they were carried out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from pymodbus.constants import ExcCodes

from gfm_hil.modbus.image import Value
from gfm_hil.modbus.view import View


class Refused(Exception):
    """A request that changes nothing, with the Modbus exception that says so."""

    def __init__(self, code: ExcCodes, why: str) -> None:
        super().__init__(why)
        self.code = code


@dataclass(frozen=True)
class Plan:
    """Commands for the run, in order; ``keep`` is called once all of them were carried out,
    ``fail`` if one was refused."""

    events: tuple[dict[str, Any], ...] = ()
    keep: Callable[[], None] = lambda: None
    fail: Callable[[], None] = lambda: None


class Function(Protocol):
    """A group of points that are written together and mean something together.

    ``plan`` works out what a write would come to and brings nothing into force itself; it raises
    ValueError for values that cannot be.
    """

    @property
    def writable(self) -> tuple[str, ...]:
        """Paths of the points that clients may write."""
        ...

    def plan(self, written: Mapping[str, Value], view: View, now: float) -> Plan:
        """What writing these values at the time ``now`` of the device, s, comes to."""
        ...

    def forget(self) -> None:
        """The run was reset, or is commanded from elsewhere: nothing of ours is in force."""
        ...

    def show(self, view: View, now: float) -> dict[str, Value]:
        """What its points read."""
        ...
