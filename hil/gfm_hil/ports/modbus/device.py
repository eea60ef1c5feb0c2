"""The device: one register image, the commands that writes cause, and a clock for timers.

A request is carried out as a whole or not at all: the device checks every value, sends the
resulting commands to the run, which checks them again, and only then stores anything. It carries
out one request at a time; clients can read meanwhile.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from pymodbus.constants import ExcCodes

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity
from gfm_hil.core.rate import Rate
from gfm_hil.ports.modbus.grid_forming import GridForming
from gfm_hil.ports.modbus.image import VENDOR, Image, SunSpecPoint, Value
from gfm_hil.ports.modbus.measures import Measures, RunState
from gfm_hil.ports.modbus.points import (
    ActiveLaw,
    Direct,
    Droop,
    Effect,
    Heartbeat,
    LawDroops,
    Operation,
    PointGroup,
    SetPoint,
    VoltVar,
)
from gfm_hil.ports.port import Refusal, refusing
from gfm_hil.recording.run import bases
from gfm_hil.scenario import Scenario

#: carries out a command, or raises UserError
Command = Callable[[dict[str, Any]], object]

READ, WRITE_ONE, WRITE_MANY = 3, 6, 16  # function codes

_AT_ONCE = {
    f"{VENDOR}.VRef": ("V_ref", 1.0), f"{VENDOR}.Dp": ("D_p", 1.0), f"{VENDOR}.Dq": ("D_q", 1.0),
}  # fmt: skip

TICK_S = 0.01
"""Of the device's clock: timers and heartbeats expire on its ticks."""


@dataclass(frozen=True)
class Client:
    """The identity of a client and its rate limit for commands."""

    identity: Identity
    rate: Rate


CLIENT: ContextVar[Client | None] = ContextVar("client", default=None)
"""The client whose request is being carried out; None if a timer caused the command."""


class Device:
    """A SunSpec device for one run, of a network for that of one converter.

    Args:
        scenario: of the run.
        laws: names of the laws that are ready.
        newest: returns the newest tick.
        command: sends a command to the run; called in a separate thread.
        heartbeat_ms: timeout of a client's heartbeat, 0: none.
        elapsed_s: time since the device was started, s.
        unit: under which the device answers.

    Attributes:
        local: the bench commands; clients are refused.
        slack: as ``Watcher.slack`` returned it last.
    """

    def __init__(
        self,
        scenario: Scenario,
        laws: Sequence[str],
        newest: Callable[[], RunState | None],
        command: Command,
        heartbeat_ms: int,
        elapsed_s: Callable[[], float],
        unit: int = 1,
    ) -> None:
        self.unit = unit
        self._newest, self._command, self._elapsed_s = newest, command, elapsed_s
        gains, self._measures = LawDroops(laws), Measures(scenario)
        rating = bases(scenario).S_n
        self._set_points = (
            SetPoint("WSet", "P_ref", rating, absolute=1, percent=(0,)),
            SetPoint("VarSet", "Q_ref", rating, absolute=4, percent=(0, 1, 3)),
        )
        self._heart = Heartbeat(heartbeat_ms)
        self._groups: tuple[PointGroup, ...] = (
            *self._set_points, VoltVar(gains), Droop(gains), self._heart, Operation(),
            ActiveLaw(laws), Direct(gains, _AT_ONCE), GridForming(gains, scenario),
        )  # fmt: skip
        self._owner = {path: group for group in self._groups for path in group.writable}
        models = dict(self._measures.models(laws))
        for group in self._groups:
            models |= group.layout
        self.image = Image(dict(sorted(models.items())))
        self._show(self._measures.plate(laws, unit))
        self._lock = asyncio.Lock()
        self._was_safe = False
        self._beats, self._seen, self._second = 0, -1, 0
        self._fresh = -1  # the device's tick at the last refresh
        self.slack: Mapping[str, float] = {}
        self.local = False
        self.refresh()

    def writable(self, point: SunSpecPoint) -> bool:
        """Whether clients may write a point."""
        return point.path in self._owner

    def refresh(self) -> None:
        """Update every register to the newest tick."""
        run, now = self._newest(), self._elapsed_s()
        self._fresh = int(now / TICK_S)
        if run is None:
            return
        if self._was_safe and not run.safe:  # the run was reset
            self._forget()
        self._was_safe = run.safe
        values = self._measures.now(run, self.slack, self._beats, self._heart.missing, self.local)
        for group in self._groups:
            values |= group.show(run, now)
        self._show(values)

    def _show(self, values: dict[str, Value]) -> None:
        for path, value in values.items():
            self.image.set(path, value)

    def take(self, local: bool) -> None:
        """Set who commands: the bench (``local``) or the clients, whose commands then stay in
        force and are reverted by no timer."""
        if local and not self.local:
            self._forget()
        self.local = local

    async def clock(self) -> None:
        """One tick of the device's clock: carry out the timers that have expired."""
        now = self._elapsed_s()
        if int(now) != self._second:
            self._second = int(now)
            run = self._newest()
            if run is not None and run.tick != self._seen:  # the device of a stalled run is dead
                self._beats, self._seen = self._beats + 1, run.tick
        if self._heart.lost(now):
            for set_point in self._set_points:
                set_point.end(now)
        for set_point in [s for s in self._set_points if s.expired(now)]:
            async with self._lock:
                run = self._newest()
                if run is None or not set_point.expired(now):  # a client has just written it
                    continue
                try:
                    await self._carry_out([set_point.revert(run, now)])
                except UserError as problem:  # retried at the next tick
                    self.image.set(f"{VENDOR}.Refd", str(problem))
                else:
                    self.refresh()

    async def access(self, address: int, written: Sequence[Any] | None) -> ExcCodes | None:
        """Process a request from pymodbus; None: pymodbus answers it from the image.

        Raises nothing: a refused request changes nothing; the vendor model shows the reason.
        """
        if written is None:
            if int(self._elapsed_s() / TICK_S) != self._fresh:
                self.refresh()
            return None
        try:
            await self._write(address, [int(r) for r in written])
        except Refusal as problem:
            self.image.set(f"{VENDOR}.Refd", str(problem))
            return ExcCodes(problem.code)
        return None

    async def _write(self, address: int, registers: list[int]) -> None:
        points = self.image.split(address, registers)
        if points is None:
            raise Refusal(ExcCodes.ILLEGAL_ADDRESS, f"{address}: no whole points")
        for point, _ in points:
            if not self.writable(point):
                raise Refusal(ExcCodes.ILLEGAL_ADDRESS, f"{point.path}: is not for writing")
        if self.local and any(point.path != "715.ControllerHb" for point, _ in points):
            raise Refusal(ExcCodes.ILLEGAL_FUNCTION, "local control: the bench is commanded there")
        async with self._lock:
            run = self._newest()
            if run is None:
                raise Refusal(ExcCodes.DEVICE_FAILURE, "the run has not begun")
            plans = self._plans(points, run)
            _count(plans)
            with refusing(ExcCodes.DEVICE_FAILURE, UserError):
                await self._carry_out(plans)
        self.refresh()

    def _plans(
        self, points: Sequence[tuple[SunSpecPoint, Sequence[int]]], run: RunState
    ) -> list[Effect]:
        by_group: dict[PointGroup, dict[str, Value]] = {}
        with refusing(ExcCodes.ILLEGAL_VALUE, ValueError):
            for point, part in points:
                value = point.decode(part)
                if value is None:
                    raise ValueError(f"{point.path}: no value")
                point.check(value)
                by_group.setdefault(self._owner[point.path], {})[point.path] = value
            now = self._elapsed_s()
            return [group.plan(values, run, now) for group, values in by_group.items()]

    async def _carry_out(self, plans: Sequence[Effect]) -> None:
        """Send the run every command, then store the new state; raises UserError if the run
        refused one."""
        try:
            for plan in plans:
                for event in plan.events:
                    await asyncio.to_thread(self._command, event)
                    if event["type"] == "reset":
                        self._forget()
        except UserError:
            for plan in plans:
                plan.on_refusal()
            raise
        for plan in plans:
            plan.on_success()

    def _forget(self) -> None:
        for group in self._groups:
            group.forget()


def _count(plans: Sequence[Effect]) -> None:
    """Apply the client's rate limit to a request that causes commands; a stop always passes."""
    client = CLIENT.get()
    kinds = [event["type"] for plan in plans for event in plan.events]
    if client is None or not kinds or "stop" in kinds:
        return
    with refusing(ExcCodes.DEVICE_BUSY, UserError):
        client.rate.take()
