"""Carries out a scenario's events tick by tick and logs what happens.

The log has one JSON object a line and is written at once, so that it survives any end of a run. If
it cannot be written, as on a full disk, the run ends; a file reserves room for the last lines.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gfm_hil.controllers import ControllerError
from gfm_hil.core.errors import naming
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.snapshot import keep_snapshot
from gfm_hil.recording.log import Outcome, Status
from gfm_hil.scenario.events.base import Event, PlantEvent, nominal_hz
from gfm_plant import Network, SynchroCheckResult, finish_check, trip_reason, wait_reason
from gfm_plant.names import CONTROLLER, NOT_ASKED
from gfm_runtime.signals import carried, names
from gfm_runtime.states import BAD_SENSOR, BAD_U, BAD_Y, PLANT_TRIP, REASONS, SAFE

_SNAPSHOT = object()
_ROOM = 1 << 16  # bytes kept beside the log for its last lines


@dataclass
class Ticket:
    """The outcome of an operator's event: its tick once ``done``, or an error."""

    operator: dict[str, Any]
    others: Sequence[Timeline] = ()  # of the other converters, whose logs name the event too
    done: threading.Event = field(default_factory=threading.Event)
    tick: int = -1
    error: str = ""
    _owner: threading.Lock = field(default_factory=threading.Lock)

    def claim(self) -> bool:
        """True for the first caller: the loop to carry it out, or the sender to withdraw it."""
        return self._owner.acquire(blocking=False)


class Timeline:
    """The events of one side, or of both in process, and the log of the run.

    Args:
        bench: the records that events act on.
        log: file to append to.
        roles: which events are ours.

    Raises:
        UserError: the disk is full.
    """

    def __init__(self, bench: Bench, log: Path, roles: tuple[Role, ...]) -> None:
        self._bench, self._roles = bench, roles
        self._open(log)
        self._unwritten = b""
        self.failed = ""  # why the log cannot be written; empty if it can
        scenario = bench.scenario
        ours: list[tuple[int, Any]] = [
            (e.at(scenario.T_s), e) for e in scenario.sorted_events() if e.side in roles
        ]
        for begin, e in [(k, e) for k, e in ours if isinstance(e, PlantEvent)]:
            ours += [(begin + k, point) for k, point in e.course(bench.plant)]
        if scenario.snapshot is not None:  # before the events of its tick
            ours.insert(0, (round(scenario.snapshot / scenario.T_s), _SNAPSHOT))
        self._todo = deque[tuple[int, Any]](sorted(ours, key=lambda entry: entry[0]))
        self._inbox: deque[tuple[Any, Ticket]] = deque()
        self._changes = int(bench.controller.ctl["changes"][0])  # more after a snapshot
        self._lines: deque[dict[str, Any]] = deque()
        self.put_off = False  # a write may take longer than a tick
        self.outcome: Outcome | None = None
        self._fault: tuple[Status, str] | None = None  # the run waits for its reset
        self._waits = NOT_ASKED  # what a converter that was reset waited for
        self.stopped_by: dict[str, Any] | None = None  # the operator who stopped the run

    def _open(self, log: Path) -> None:
        self._path, self._room = log, log.with_suffix(".room")
        with naming(log):
            self._log = log.open("ab", buffering=0)
            with self._room.open("wb") as room:
                os.posix_fallocate(room.fileno(), 0, _ROOM)

    @property
    def running(self) -> bool:
        """Nothing has ended the run yet."""
        return self.outcome is None

    def next_tick(self) -> int:
        """Tick of the next event; far away if there is none."""
        return self._todo[0][0] if self._todo else 2**62

    def insert(
        self, event: Event, operator: dict[str, Any], others: Sequence[Timeline] = ()
    ) -> Ticket:
        """Queue an event for the next tick; any thread may call this.

        Args:
            event: a checked one.
            operator: identity of the sender, for the log.
            others: of the other converters of the plant.
        """
        ticket = Ticket(operator, others)
        self._inbox.append((event, ticket))
        return ticket

    def carry_out(self, tick: int) -> None:
        """Carry out every event due at this tick, and the queued ones."""
        while self._todo and self._todo[0][0] <= tick:
            event = self._todo.popleft()[1]
            if event is _SNAPSHOT:
                self._keep(tick)
                continue
            if not isinstance(event, Event):  # a point of an event's course
                if self._bench.place == 0:
                    event.apply(self._bench.plant)
                continue
            try:
                self._carry_out(event, tick)
            except ValueError as problem:
                self.write(tick, event.type, label=self.label(event), refused=str(problem))
        while self._inbox:
            event, ticket = self._inbox.popleft()
            if not ticket.claim():
                continue
            try:
                said = {"by": "operator", "operator": ticket.operator}
                self._carry_out(event, tick, **said)
                for other in ticket.others:
                    other.write(tick, event.type, label=self.label(event), **said)
                ticket.tick = tick
            except ValueError as problem:  # the plant changed after the check
                ticket.error = str(problem)
            ticket.done.set()

    def _carry_out(self, event: Event, tick: int, **more: Any) -> None:
        if self._bench.external is not None:
            self._bench.external.check(event, self._bench.controller)
        event.carry_out(self._bench)
        self.write(tick, event.type, label=self.label(event), **more)

    def _keep(self, tick: int) -> None:
        """Keep the state at a tick for other runs."""
        try:
            keep_snapshot(self._bench, self._path.parent, self._roles)
        except (ValueError, OSError, ControllerError) as problem:
            why = getattr(problem, "strerror", None) or problem
            self.end("safe", f"the snapshot cannot be kept: {why}", tick)

    def label(self, event: Event) -> str:
        """What results call an event; no file is read for it while the loop runs."""
        return event.label_in(self._bench)

    def look(self, tick: int) -> None:
        """Log what came with the last tick: a change of law, a safe state, a trip."""
        ctl, st = self._bench.controller.ctl, self._bench.plant.st
        if "controller" in self._roles and int(ctl["changes"][0]) != self._changes:
            self._changes = int(ctl["changes"][0])
            self.write(
                tick, "law-active", law=self._bench.controller.active, bump_pu=float(ctl["bump"][0])
            )
        found = self._found(ctl, st)
        if found is not None and self._fault is None:
            mine = st[self._bench.place]
            tripped = "plant" in self._roles and mine["trip"] not in (0, CONTROLLER)
            # the one time of a trip: when the bridge blocks, in the state that is beyond its limit
            # one that began tripped, from a snapshot, is so from its first tick on
            at = max(0, int(mine["trip_tick"]) - self._bench.before) if tripped else tick
            if self._bench.scenario.after_trip == "end":
                self.end(*found, at)
                return
            self.write(at, found[0], reason=found[1], role="+".join(self._roles))
        elif found is None and self._fault is not None:
            self.write(tick, "recovered", role="+".join(self._roles))
        self._fault = found
        waits = int(st["waits"][self._bench.place]) if "plant" in self._roles else NOT_ASKED
        if waits != self._waits and (
            why := wait_reason(self._bench.plant.records, self._bench.place)
        ):
            self.write(tick, "waits", reason=why)
        self._waits = waits

    def _found(self, ctl: Any, st: Any) -> tuple[Status, str] | None:
        """The fault that keeps our side from running, if any; the cause before its consequences."""
        trip = int(st["trip"][self._bench.place]) if "plant" in self._roles else 0
        bench = self._bench
        why = trip_reason(bench.plant.records, bench.place, bench.before) if trip else ""
        if trip not in (0, CONTROLLER):
            return "tripped", why
        if "controller" in self._roles and int(ctl["state"][0]) == SAFE:
            heard = int(ctl["reason"][0]) == PLANT_TRIP
            return "tripped" if heard else "safe", safe_reason(ctl)
        return ("safe", why) if trip else None

    def checked(self, found: SynchroCheckResult, tick: int) -> None:
        """Log how a synchro-check has ended."""
        kind = "breaker" if found.name else "grid-breaker"
        name, f_b = found.name or "grid breaker", nominal_hz(self._bench.plant)
        said = (
            f"dV = {found.V:.4f} p.u., df = {found.omega * f_b:.4f} Hz, dphi = {found.degrees:.2f}"
            " degrees"
        )
        if found.closed:
            self.write(tick, kind, label=f"{name} on, synchronous", found=said)
        else:
            refused = f"the sides did not agree in time: {said}"
            self.write(tick, kind, label=f"{name} stays off", refused=refused)

    def finish(self, tick: int) -> None:
        """The scenario is over: the run is complete unless it still waits for a reset."""
        self.end(*(self._fault or ("completed", "")), tick)

    def end(self, status: Status, reason: str, tick: int) -> None:
        """End the run, with tick -1 before its tick 0; the first reason stays."""
        if self.outcome is None:
            tick = max(tick, 0)
            if self.failed and status == "interrupted":
                status, reason = "safe", self.failed
            self.outcome = Outcome(status, reason, tick)
            role, now = "+".join(self._roles), time.monotonic_ns()  # the clock of timing.npz
            more: dict[str, Any] = {}
            if status == "interrupted" and self.stopped_by is not None:
                more = {"operator": self.stopped_by}
            self.write(tick, "end", status=status, reason=reason, role=role, clock_ns=now, **more)

    def write(self, tick: int, kind: str, **more: Any) -> None:
        """Add a line to the log; on disk at once, or at the next ``flush`` if ``put_off``."""
        t = round(tick * self._bench.scenario.T_s, 9)
        self._lines.append({"tick": tick, "t": t, "event": kind, **more})
        if not self.put_off:
            self.flush()

    def flush(self) -> None:
        """Write what is not on disk yet; another thread may call this."""
        tick = 0
        while self._lines:
            line = self._lines.popleft()
            tick = line["tick"]
            self._unwritten += (json.dumps(line) + "\n").encode()
        try:
            while self._unwritten:
                self._unwritten = self._unwritten[self._log.write(self._unwritten) :]
        except OSError as problem:
            if self.failed:  # no room at all: ``close`` tries again
                return
            self.failed = f"{self._path.name} cannot be written: {problem.strerror}"
            self._room.unlink(missing_ok=True)
            if not self.put_off:  # else the flushing thread stops the loop, which ends the run
                self.end("interrupted", "", tick)
            self.flush()

    def close(self) -> None:
        """Close the log."""
        self.flush()
        self._log.close()
        self._room.unlink(missing_ok=True)


def report_check(plant: Network, timelines: Sequence[Timeline], tick: int) -> None:
    """Carry out what a synchro-check of the plant has found before a tick, and log it."""
    found = finish_check(plant)
    if found is not None:
        for timeline in timelines:
            timeline.checked(found, tick)


class TimelineInMemory(Timeline):
    """The events of a run in process, whose log stays in ``lines``."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench, Path(), ROLES)
        self.lines: list[dict[str, Any]] = []

    def _open(self, log: Path) -> None:
        pass

    def write(self, tick: int, kind: str, **more: Any) -> None:
        """Add a line to ``lines``."""
        t = round(tick * self._bench.scenario.T_s, 9)
        self.lines.append({"tick": tick, "t": t, "event": kind, **more})

    def close(self) -> None:
        """There is no file."""


def safe_reason(ctl: Any) -> str:
    """The reason for which the controller is in SAFE, in words."""
    reason, channel = int(ctl["reason"][0]), int(ctl["channel"][0])
    of = {BAD_Y: carried("y", True), BAD_U: carried("u", True), BAD_SENSOR: names("adc")}
    return REASONS[reason] + (f": {of[reason][channel]}" if reason in of else "")
