"""Both sides in one process: the same tick functions in one compiled loop, in lockstep.

The result is bit for bit that of two processes over a link, because a frame carries float64 and
each tick calls the same functions in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.loop_records import ControllerRecords, Why
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.tick import answer, obey, sample, take
from gfm_hil.engine.timeline import Timeline
from gfm_hil.recording.columns import (
    CONTROLLER_TIMES,
    PLANT_TIMES,
    signals_of,
)
from gfm_hil.recording.parts import Part
from gfm_hil.recording.recorder import record_command, record_controller
from gfm_plant import plant_is_delayed, plant_step
from gfm_runtime.compiled import compiled
from gfm_runtime.states import READY

CHUNK = 2000  # ticks between two looks at the stop flag and the progress bar


@compiled
def _run_ticks(plant, controller, y, u, plant_rows, controller_rows, start, stop, waits):
    """The compiled part of ``run_ticks``."""
    st = plant.st
    ctl, laws, states, est = controller
    changes, delayed = ctl[0].changes, plant_is_delayed(plant)
    for k in range(start, stop):
        before = ctl[0].state
        tripped = sample(plant, 0, y, plant_rows[k])
        answer(ctl, laws, states, est, y, u, tripped != 0)
        record_controller(controller_rows[k], ctl, states, est)
        record_command(plant_rows[k], u)
        if delayed:  # as over a link, where u[k] may come meanwhile
            plant_step(plant)
        state = ctl[0].state
        if obey(plant, 0, waits, state) != Why.GO_ON:
            return k + 1
        if take(plant, 0, u, tripped, state, True) != Why.GO_ON:
            return k + 1
        if not delayed:
            plant_step(plant)
        if ctl[0].changes != changes or state != before or st[0].trip != tripped:
            return k + 1
    return stop


def run_ticks(
    bench: Bench,
    plant_rows: NDArray[np.float64],
    controller_rows: NDArray[np.float64],
    start: int,
    stop: int,
) -> int:
    """Run ticks [start, stop) of a bench; returns the tick after the last one done.

    Returns early, after recording the tick, when the law, the controller's state or the plant's
    protection changed, and before the plant takes u[k] when it has to be put back to its start.

    Args:
        bench: at tick ``start``.
        plant_rows, controller_rows: of every tick, columns as ``signals_of`` says.
    """
    c = bench.controller
    return int(_run_ticks(
        bench.plant.records,
        ControllerRecords(c.ctl, c.laws, c.states, c.est),
        bench.y, bench.u, plant_rows, controller_rows, start, stop,
        bench.scenario.after_trip == "wait",
    ))  # fmt: skip


def run_inproc(
    bench: Bench,
    plant_part: Part,
    controller_part: Part,
    timeline: Timeline,
    go_on: Callable[[int], bool],
) -> None:
    """Run a whole scenario; ``go_on`` gets the ticks done and returns whether to go on."""
    ticks = bench.scenario.ticks
    k = 0
    while k < ticks and timeline.running:
        timeline.carry_out(k)
        stop = min(k + CHUNK, timeline.next_tick(), ticks)
        k = run_ticks(bench, plant_part.signals, controller_part.signals, k, stop)
        if int(bench.plant.st["trip"][0]) and int(bench.controller.ctl["state"][0]) == READY:
            bench.restore_plant(k)
        timeline.look(k - 1)
        if not go_on(k):
            timeline.end("interrupted", "stopped by the operator", k)
    timeline.finish(k)


def buffers(ticks: int, inner: bool = False) -> tuple[Part, Part]:
    """Room in memory to record one run, with an inner stage or not: the plant's and the
    controller's."""

    def part(columns: Sequence[str], times: Sequence[str]) -> Part:
        return Part(
            np.empty((ticks, len(columns))),
            np.empty((0, len(times)), np.int64),  # lockstep has no times
            np.zeros(2, np.int64),
        )

    return (
        part(signals_of("plant", inner), PLANT_TIMES),
        part(signals_of("controller", inner), CONTROLLER_TIMES),
    )


def compile_loop(bench: Bench, plant_part: Part, controller_part: Part) -> None:
    """Compile (or load from cache) the loop without running a tick."""
    run_ticks(bench, plant_part.signals, controller_part.signals, 0, 0)
