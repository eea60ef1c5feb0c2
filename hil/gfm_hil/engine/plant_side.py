"""The plant process: samples y[k], sends it, takes u[k], goes on by one tick.

Lockstep: waits for u[k], whatever it takes. Real time: tick k is sampled at its deadline
t_0 + k T_s on CLOCK_MONOTONIC; u[k] has until the next deadline. What is not there by then is a
miss: the plant goes on with the newest u it has, and after ``late_policy.hold`` in a row blocks.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass

from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.engine.waiting import await_message, part_from
from gfm_hil.links import Link
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_hil.recording.log import CONTROLLER_LEFT
from gfm_hil.recording.parts import Part
from gfm_hil.recording.recorder import record_command, record_sample
from gfm_hil.scenario.expectation import CONTROLLER_GONE
from gfm_plant import NO_FRESH_U, plant_ahead, plant_go_on, plant_sample, plant_take
from gfm_plant.names import CONTROLLER, SAFE_STATE, SILENT
from gfm_plant.protection import trip
from gfm_runtime.states import PLANT_TRIP, READY, REASONS, SAFE, STOPPED

_QUEUED = 64  # frames that the plant still takes in a tick whose time is over


@dataclass
class _Plant:
    """What one run of the plant's side holds on to."""

    bench: Bench
    link: Link
    part: Part
    timeline: Timeline
    stopped: Callable[[], bool]

    def __post_init__(self) -> None:
        self.reader = FrameReader.of("plant", self.bench.scenario)
        self.writer = FrameWriter("y")
        self.T_ns = round(self.bench.scenario.T_s * 1e9)
        self.patience_ns = int(self.bench.scenario.link.peer_timeout_s * 1e9)
        self.repeat_ns = int(self.bench.scenario.link.repeat_s * 1e9)
        self.u_last = self.u_before = self.bench.u.copy()  # the newest two that came in time
        self.waits = self.bench.scenario.after_trip == "wait"
        self.tripped, self.ahead = 0, plant_ahead(self.bench.par)
        self.misses = 0
        self.late = 0  # misses in a row

    def sample(self, tick: int) -> None:
        b = self.bench
        self.reader.record["newest"] = tick
        self.timeline.carry_out(tick)
        plant_sample(b.par, b.st, b.y)
        self.tripped = int(b.st["trip"][0])
        self.link.send(self.frame(tick))
        self.part.times[tick, 2] = time.monotonic_ns()
        record_sample(self.part.signals[tick], b.y, b.par, b.st)
        if self.ahead:  # u[k] does not act in this period: it can come meanwhile
            plant_go_on(b.par, b.st)

    def frame(self, tick: int) -> bytes:
        state, reason = (SAFE, PLANT_TRIP) if self.tripped else (0, 0)
        return self.writer.pack(tick, state, reason, self.bench.y)

    def take(self, frame: bytes) -> int:
        """Tick of a good frame, its values now in ``bench.u``; -1 for one that was refused."""
        try:
            return self.reader.unpack(frame, self.bench.u)
        except FrameError:
            return -1

    def advance(self, tick: int, fresh: bool) -> None:
        b = self.bench
        record_command(self.part.signals[tick], b.u)
        self.part.progress[0] = tick + 1
        if self.reader.state == SAFE:
            if not self.waits:
                self.timeline.end("safe", REASONS[self.reader.reason], tick)
                return
            trip(b.st[0], CONTROLLER, SAFE_STATE)
        if self.reader.state == STOPPED:
            self.timeline.end("interrupted", CONTROLLER_LEFT, tick)
            return
        self.reader.judge(self.late > self.bench.scenario.late_policy.hold, self.tripped != 0)
        if self.tripped and fresh and self.reader.state == READY:
            b.restore_plant(tick + 1)
            self.u_last = self.u_before = b.u.copy()
            return
        plant_take(b.par, b.st, b.u)
        if not self.ahead:
            plant_go_on(b.par, b.st)
        if self.waits and self.reader.e2e == "invalid":
            trip(b.st[0], CONTROLLER, SILENT)

    def lockstep(self, tick: int) -> None:
        self.sample(tick)
        now = time.monotonic_ns()
        deadline, again = now + self.patience_ns, now + self.repeat_ns
        while True:
            frame = await_message(self.link, min(deadline, again), self.stopped)
            # a controller that leaves says so under the last tick it saw
            if frame is not None and (self.take(frame) == tick or self.reader.left):
                self.part.times[tick, 3] = time.monotonic_ns()
                self.advance(tick, True)
                return
            now = time.monotonic_ns()
            if now >= deadline or self.stopped():
                break
            if now >= again:  # y[k] or u[k] was lost: ask again
                again = now + self.repeat_ns
                self.link.send(self.frame(tick))
        if not self.stopped():
            self.reader.judge(True, True)
            self.timeline.end("safe", CONTROLLER_GONE, tick)

    def realtime(self, tick: int, deadline: int) -> None:
        times = self.part.times[tick]
        times[0], times[1] = deadline, time.monotonic_ns()
        self.sample(tick)
        newest = -1
        until = deadline + self.T_ns
        in_queue = _QUEUED
        while newest < tick and in_queue > 0:
            frame = self.link.receive()
            now = time.monotonic_ns()
            if frame is not None:
                newest = max(newest, self.take(frame))
                times[3] = now if newest == tick else -1
                in_queue -= now >= until
            elif now >= until:
                break
            else:
                os.sched_yield()
        if newest == tick:
            self.u_before, self.u_last = self.u_last, self.bench.u.copy()
        elif self.late < self.bench.scenario.late_policy.extrapolate:
            self.bench.u[:] = self.u_last + (self.late + 1) * (self.u_last - self.u_before)
        self.late = 0 if newest == tick else self.late + 1
        self.misses += newest != tick
        self.part.progress[1] = self.misses
        self.advance(tick, newest == tick)
        while time.monotonic_ns() < until:
            os.sched_yield()
        if self.late * self.T_ns >= self.patience_ns:
            self.reader.judge(True, True)
            self.timeline.end("safe", CONTROLLER_GONE, tick)
        elif self.reader.e2e == "invalid" and not self.waits:
            self.timeline.end("safe", NO_FRESH_U, tick)


def run_plant(
    bench: Bench,
    link: Link,
    part: Part,
    timeline: Timeline,
    t0_ns: int,
    stopped: Callable[[], bool],
) -> FrameReader:
    """Run the plant's side of a scenario after the handshake; returns its frame counters."""
    p = _Plant(bench, link, part, timeline, stopped)
    ticks, realtime = bench.scenario.ticks, bench.scenario.mode == "realtime"
    if realtime:
        while time.monotonic_ns() < t0_ns:
            os.sched_yield()
    tick = 0
    while tick < ticks and timeline.running and not stopped():
        if realtime:
            p.realtime(tick, t0_ns + tick * p.T_ns)
        else:
            p.lockstep(tick)
        timeline.look(tick)
        tick += 1
    if stopped():
        timeline.end("interrupted", "stopped by the operator", tick)
    timeline.finish(tick)
    assert timeline.outcome is not None
    status = timeline.outcome.status
    state = SAFE if status == "tripped" and not p.waits else STOPPED
    failed = int(status != "completed" and tick < ticks)
    part_from(link, p.writer, p.reader, tick, state, failed, bench.y)
    return p.reader
