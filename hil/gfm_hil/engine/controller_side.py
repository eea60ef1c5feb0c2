"""The controller process: y[k] in, u[k] out, until somebody ends it.

It is driven by the plant's frames. In real time it also watches the clock: ticks that pass
without a frame are counted and, beyond ``late_policy.hold``, lead to the safe state.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.engine.waiting import await_message, part_from
from gfm_hil.links import Link
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_hil.recording.log import PLANT_LEFT
from gfm_hil.recording.parts import Part
from gfm_hil.recording.recorder import record_controller
from gfm_runtime.controller import heed, missed
from gfm_runtime.states import LOST_PEER, PLANT_TRIP, REASONS, SAFE, STOPPED


def run_controller(
    bench: Bench,
    link: Link,
    part: Part,
    timeline: Timeline,
    t0_ns: int,
    stopped: Callable[[], bool],
) -> FrameReader:
    """Run the controller's side of a scenario after the handshake; returns its frame counters."""
    scenario, c = bench.scenario, bench.controller
    realtime = scenario.mode == "realtime"
    T_ns = round(scenario.T_s * 1e9)
    patience_ns = int(scenario.link.peer_timeout_s * 1e9)
    reader, writer = FrameReader.of("controller", scenario), FrameWriter("u")
    signals, times, progress = part.signals, part.times, part.progress
    waits = scenario.after_trip == "wait"
    done, tick = 0, 0  # ticks processed; the tick of the newest frame
    heard = max(time.monotonic_ns(), t0_ns)

    def leave(status: str, reason: str, state: int, code: int) -> None:
        timeline.end(status, reason, tick)  # type: ignore[arg-type]
        part_from(link, writer, reader, tick, state, code, bench.u)

    def look() -> None:
        timeline.look(tick)
        if not timeline.running:
            part_from(link, writer, reader, tick, SAFE, int(c.ctl["reason"][0]), bench.u)

    while timeline.running:
        reader.judge(False, c.ctl["state"][0] == SAFE)
        until = time.monotonic_ns() + T_ns if realtime else heard + patience_ns
        frame = await_message(link, until, stopped)
        now = time.monotonic_ns()
        if stopped():
            leave("interrupted", "stopped by the operator", STOPPED, 0)
            break
        newest, before = -1, reader.tick
        if frame is not None:
            with contextlib.suppress(FrameError):  # counted; in lockstep the plant will ask again
                newest = reader.unpack(frame, bench.y)
        if newest < 0:
            if now - heard >= patience_ns:
                reader.judge(True, True)
                leave("safe", REASONS[LOST_PEER], SAFE, LOST_PEER)
            elif realtime and done:  # before tick 0 nothing can be stale
                while int(c.ctl["stale"][0]) < (now - heard) // T_ns:
                    missed(c.ctl)
                reader.judge(c.ctl["stale"][0] > c.ctl["hold"][0], True)
                look()
            continue
        if newest > before:  # nothing else is a sign of life
            heard = now
        if reader.state == SAFE and not waits:
            leave("tripped", REASONS[PLANT_TRIP], SAFE, PLANT_TRIP)
            break
        if reader.state == STOPPED:
            if reader.reason:
                leave("interrupted", PLANT_LEFT, STOPPED, 0)
            else:
                timeline.finish(tick)
                part_from(link, writer, reader, tick, STOPPED, 0, bench.u)
            break
        if newest <= before:  # the plant asks again: our answer was lost
            link.send(writer.pack(tick, int(c.ctl["state"][0]), int(c.ctl["reason"][0]), bench.u))
            continue
        tick = newest
        timeline.carry_out(tick)
        heed(c.ctl, reader.state == SAFE)
        c.step(bench.y, bench.u)
        computed = time.monotonic_ns()
        link.send(writer.pack(tick, int(c.ctl["state"][0]), int(c.ctl["reason"][0]), bench.u))
        row = times[tick]
        row[0], row[1], row[2], row[3] = t0_ns + tick * T_ns, now, computed, time.monotonic_ns()
        record_controller(signals[tick], c.ctl, c.est)
        done += 1
        progress[0], progress[1] = tick + 1, int(c.ctl["reason"][0])
        look()
    return reader
