"""Driving the compiled loops: call them, and do in Python what they came back for.

Both functions are meant for a thread of their own.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import Role
from gfm_hil.engine.controller_ticks import controller_ticks
from gfm_hil.engine.loop_records import (
    FLAGS,
    ControllerRecords,
    LinkEnd,
    Records,
    Why,
    make_loop,
)
from gfm_hil.engine.plant_ticks import plant_ticks
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.engine.waiting import part_from
from gfm_hil.links import Link, Port, port_function
from gfm_hil.links.frame import FrameReader, FrameWriter
from gfm_hil.models import ModelError
from gfm_hil.realtime.clock import now_ns, sleep_until
from gfm_hil.recording.log import CONTROLLER_LEFT, PLANT_LEFT
from gfm_hil.recording.parts import Part
from gfm_hil.scenario.expectation import CONTROLLER_GONE
from gfm_plant import NO_FRESH_U
from gfm_runtime.states import LOST_PEER, PLANT_TRIP, REASONS, SAFE, STOPPED

_FAR = 2**62  # the next tick of a timeline without events
_NAP_NS = 100_000


class _Loop:
    """One side's compiled loop with everything that its calls have in common."""

    def __init__(
        self, role: Role, bench: Bench, link: Any, part: Part, t0_ns: int, flags: NDArray[np.int64]
    ) -> None:
        assert link.port is not None
        scenario, port, c = bench.scenario, link.port, bench.controller
        plant = role == "plant"
        self.link = link
        self.writer = FrameWriter("y" if plant else "u", bench.inner)
        self.reader = FrameReader.of(role, scenario)
        self.loop = make_loop(scenario, 0 if plant else -1, t0_ns)
        self.loop["spin_limit"] = port.spin_limit
        w, r = self.writer, self.reader
        end = LinkEnd(
            port.send, port.receive, port.patient or _rest, port.handle, port.spins,
            (w.sequence, w.frame, w.message), (r.frame, r.message), r.record,
        )  # fmt: skip
        records = Records(
            self.loop, flags, bench.y, bench.u, part.signals, part.times, part.progress
        )
        own = bench.plant.records if plant else ControllerRecords(c.ctl, c.laws, c.states, c.est)
        self._arguments = end, records, own
        ticks: Callable[..., Why] = bench.model or controller_ticks
        self._call = plant_ticks if plant else ticks

    def go(self, until: int) -> Why:
        """Run until that tick, or until the loop returns for another reason.

        Raises:
            PeerLost: the link is gone.
        """
        why: Why = self._call(*self._arguments, until)
        if why == Why.GONE:
            self.link.receive()  # raises and says more
            raise PeerLost("the link is gone")
        return why

    @property
    def tick(self) -> int:
        """Plant: the next tick; controller: the last one received."""
        return int(self.loop["tick"][0])

    def keep_u(self, u: NDArray[np.float64]) -> None:
        """Take u as the two newest that came."""
        for name in ("u_last", "u_before"):
            self.loop[name][0, : len(u)] = u

    def last_words(self, state: int, reason: int, values: NDArray[np.float64]) -> None:
        """Tell the other side how this side ends."""
        tick = max(self.tick, 0)
        part_from(self.link, self.writer, self.reader, tick, state, reason, values)


def drive_plant(
    bench: Bench, link: Link, part: Part, timeline: Timeline, t0_ns: int, flags: NDArray[np.int64]
) -> FrameReader:
    """Run the plant's side of a scenario after the handshake; returns its frame counters."""
    loop, ticks = _Loop("plant", bench, link, part, t0_ns, flags), bench.scenario.ticks
    loop.keep_u(bench.u)
    waits = bench.scenario.after_trip == "wait"
    while timeline.running:
        timeline.carry_out(loop.tick)
        why = loop.go(min(timeline.next_tick(), ticks))
        tick = loop.tick
        if why == Why.RESTORE:
            bench.restore_plant(tick)
            loop.keep_u(bench.u)
        timeline.look(max(tick - 1, 0))
        if tick >= ticks and why in (Why.DONE, Why.CHANGED, Why.RESTORE):
            timeline.finish(tick)
        elif why == Why.STOPPED_HERE:
            timeline.end("interrupted", "stopped by the operator", tick)
        elif why == Why.PEER_SAFE:
            timeline.end("safe", REASONS[loop.reader.reason], tick)
        elif why == Why.PEER_STOPPED:
            timeline.end("interrupted", CONTROLLER_LEFT, tick)
        elif why == Why.SILENT:
            timeline.end("safe", CONTROLLER_GONE, tick)
        elif why == Why.LATE:
            timeline.end("safe", NO_FRESH_U, tick)
    assert timeline.outcome is not None
    status = timeline.outcome.status
    state = SAFE if status == "tripped" and not waits else STOPPED
    loop.last_words(state, int(status != "completed" and loop.tick < ticks), bench.y)
    return loop.reader


def drive_controller(
    bench: Bench, link: Link, part: Part, timeline: Timeline, t0_ns: int, flags: NDArray[np.int64]
) -> FrameReader:
    """Run the controller's side of a scenario after the handshake; returns its frame counters."""
    loop, ctl = _Loop("controller", bench, link, part, t0_ns, flags), bench.controller.ctl
    why = Why.EVENT
    if bench.model is not None:
        bench.model.last_words = lambda: loop.last_words(STOPPED, 0, bench.u)
    loop.loop["heard"] = max(time.monotonic_ns(), t0_ns)
    while timeline.running:
        event = timeline.next_tick()
        if loop.loop["pending"][0]:  # the frame of the event's own tick was lost
            timeline.carry_out(loop.tick)
            event = timeline.next_tick()
        elif event <= loop.tick + 1 or why == Why.WOKEN:
            timeline.carry_out(loop.tick + 1)
            event = timeline.next_tick()
        try:
            why = loop.go(event)
        except ModelError as problem:
            timeline.end("safe", str(problem), loop.tick)
            loop.last_words(STOPPED, 0, bench.u)
            break
        tick = loop.tick
        if why in (Why.CHANGED, Why.EVENT) and not loop.loop["pending"][0]:
            timeline.look(max(tick, 0))
        if why == Why.STOPPED_HERE:
            timeline.end("interrupted", "stopped by the operator", tick)
            loop.last_words(STOPPED, 0, bench.u)
        elif why == Why.PEER_SAFE:
            timeline.end("tripped", REASONS[PLANT_TRIP], tick)
            loop.last_words(SAFE, PLANT_TRIP, bench.u)
        elif why == Why.PEER_STOPPED:
            if loop.reader.reason:
                timeline.end("interrupted", PLANT_LEFT, tick)
            else:
                timeline.finish(tick)
            loop.last_words(STOPPED, 0, bench.u)
        elif why == Why.SILENT:
            timeline.end("safe", REASONS[LOST_PEER], tick)
            loop.last_words(SAFE, LOST_PEER, bench.u)
        elif not timeline.running:  # ``timeline.look`` found a safe state and wrote it down
            loop.last_words(SAFE, int(ctl["reason"][0]), bench.u)
    return loop.reader


def compile_loops(role: Role, bench: Bench, part: Part) -> None:
    """Compile (or load from cache) a side's loop without running a tick."""
    loop = _Loop(role, bench, _Nowhere(), part, 0, np.ones(FLAGS, np.int64))
    loop.go(_FAR if role == "controller" else 0)


@port_function
def _rest(handle, message):
    """Sleep for 100 µs: lockstep on a link that cannot sleep until a message comes."""
    sleep_until(now_ns() + _NAP_NS)
    return 0


@port_function
def _nothing(handle, message):
    return 0


class _Nowhere:
    """A link without a peer; enough to compile a loop, which is the same for all links."""

    @property
    def port(self) -> Port:
        return Port(np.zeros(1, np.int64), _nothing, _nothing, 0)
