"""Both sides in one process: the same tick functions in one compiled loop, in lockstep.

Bit for bit the result of two processes over a link, since a frame carries float64 and each tick
calls the same functions in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.recording.columns import (
    CONTROLLER_COLUMNS,
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
)
from gfm_hil.recording.parts import Part
from gfm_hil.recording.recorder import record_command, record_controller, record_sample
from gfm_plant import plant_ahead, plant_go_on, plant_sample, plant_take
from gfm_plant.names import CONTROLLER, SAFE_STATE
from gfm_plant.protection import trip
from gfm_runtime.compiled import compiled
from gfm_runtime.controller import control, heed
from gfm_runtime.states import READY, SAFE

CHUNK = 2000  # ticks between two looks at the stop flag and the progress bar


@compiled
def run_ticks(
    par, st, ctl, laws, states, est, y, u, plant_rows, controller_rows, start, stop, waits
):
    """Run ticks [start, stop); returns the tick after the last one done.

    Ends early, after recording the tick, when the law changed, when the controller entered or
    left RUNNING or when the protection tripped; and before u[k] is taken, when the plant has to
    be put back to its start: tripped, with the controller READY.
    """
    changes, ahead = ctl[0].changes, plant_ahead(par)
    for k in range(start, stop):
        before, tripped = ctl[0].state, st[0].trip
        plant_sample(par, st, y)
        heed(ctl, tripped != 0)
        control(ctl, laws, states, est, y, u)
        record_controller(controller_rows[k], ctl, est)
        record_sample(plant_rows[k], y, par, st)
        record_command(plant_rows[k], u)
        if ahead:  # as a plant does that need not wait for u[k]
            plant_go_on(par, st)
        state = ctl[0].state
        if state == SAFE:
            if not waits:
                return k + 1
            trip(st[0], CONTROLLER, SAFE_STATE)
        if state == READY and tripped != 0:
            return k + 1
        plant_take(par, st, u)
        if not ahead:
            plant_go_on(par, st)
        if ctl[0].changes != changes or state != before or st[0].trip != tripped:
            return k + 1
    return stop


def run_inproc(
    bench: Bench,
    plant_part: Part,
    controller_part: Part,
    timeline: Timeline,
    go_on: Callable[[int], bool],
) -> None:
    """Run a whole scenario; ``go_on`` is told the ticks done and says whether to go on."""
    c, ticks = bench.controller, bench.scenario.ticks
    waits = bench.scenario.after_trip == "wait"
    k = 0
    while k < ticks and timeline.running:
        timeline.carry_out(k)
        stop = min(k + CHUNK, timeline.next_tick(), ticks)
        k = run_ticks(
            bench.par, bench.st, c.ctl, c.laws, c.states, c.est, bench.y, bench.u,
            plant_part.signals, controller_part.signals, k, stop, waits,
        )  # fmt: skip
        if int(bench.st["trip"][0]) and int(c.ctl["state"][0]) == READY:
            bench.restore_plant(k)
        timeline.look(k - 1)
        if not go_on(k):
            timeline.end("interrupted", "stopped by the operator", k)
    timeline.finish(k)


def buffers(ticks: int) -> tuple[Part, Part]:
    """Room in memory to record one run: the plant's and the controller's."""

    def part(columns: Sequence[str], times: Sequence[str]) -> Part:
        return Part(
            np.empty((ticks, len(columns))),
            np.empty((0, len(times)), np.int64),  # lockstep has no times
            np.zeros(2, np.int64),
        )

    return part(PLANT_COLUMNS, PLANT_TIMES), part(CONTROLLER_COLUMNS, CONTROLLER_TIMES)


def compile_loop(bench: Bench, plant_part: Part, controller_part: Part) -> None:
    """Compile (or load from cache) the loop without running a tick."""
    c = bench.controller
    run_ticks(
        bench.par, bench.st, c.ctl, c.laws, c.states, c.est, bench.y, bench.u,
        plant_part.signals, controller_part.signals, 0, 0, False,
    )  # fmt: skip
