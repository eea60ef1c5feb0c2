"""Both sides in one process: the same tick functions in one compiled loop, in lockstep.

The result is bit for bit that of two processes over a link, because a frame carries float64 and
each tick calls the same functions in the same order.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.loop_records import ControllerRecords, ReturnReason
from gfm_hil.engine.replay import Trace, no_trace, replay, stands_still
from gfm_hil.engine.setup import Bench, follow_trips
from gfm_hil.engine.tick import answer, apply_peer_state, asks_to_start, sample, take
from gfm_hil.engine.timeline import Timeline, report_check
from gfm_hil.recording.columns import signals_of
from gfm_hil.recording.parts import Kept, RolePart
from gfm_hil.recording.recorder import record_command, record_controller
from gfm_plant import PlantRecords, plant_flows, plant_is_delayed, plant_step
from gfm_plant.synchro_check import WATCHING
from gfm_runtime.compiled import compiled
from gfm_runtime.states import READY

CHUNK = 10_000  # ticks of all converters between two looks at the stop flag and the progress bar
_PIECE = 1_000  # ticks of all converters that are recorded at a time, in the processor's cache
# the least of both in a network: Python handles each converter at the end of each
_LEAST_CHUNK, _LEAST_PIECE = 1_000, 100


class Stack(NamedTuple):
    """The controllers of a plant, one below the other."""

    # their records: ctl and est of shape (N,), laws and states of shape (N, laws)
    controllers: ControllerRecords
    y: NDArray[np.float64]  # measurements of the current tick, (N, 5) or (N, 11), p.u.
    u: NDArray[np.float64]  # inputs of the current tick, (N, 3) or (N, 4), p.u.


def stack(benches: Sequence[Bench]) -> Stack:
    """The records of all benches in common arrays, of which each bench then has its part."""
    if len(benches) == 1:
        (b,) = benches
        c = b.controller
        one = ControllerRecords(c.ctl, c.laws[None], c.states[None], c.est)
        return Stack(one, b.y[None], b.u[None])
    all_c = [b.controller for b in benches]
    most = max(len(c.laws) for c in all_c)
    ctl = np.concatenate([c.ctl for c in all_c])
    est = np.concatenate([c.est for c in all_c])
    laws = np.zeros((len(all_c), most), all_c[0].laws.dtype)
    states = np.zeros((len(all_c), most), all_c[0].states.dtype)
    y, u = np.stack([b.y for b in benches]), np.stack([b.u for b in benches])
    for k, (b, c) in enumerate(zip(benches, all_c, strict=True)):
        n = len(c.laws)
        laws[k, :n], states[k, :n] = c.laws, c.states
        c.ctl, c.est = ctl[k : k + 1], est[k : k + 1]
        c.laws, c.states = laws[k, :n], states[k, :n]
        b.y, b.u = y[k], u[k]
    return Stack(ControllerRecords(ctl, laws, states, est), y, u)


@compiled
def _run_ticks(
    plant, stack, plant_rows, controller_rows, flows, start, stop, first, survives_trip, plan, kept
):
    """``run_ticks``; also whether every tick was done and left nothing to see to."""
    ctl, laws, states, est = stack.controllers
    y, u, st = stack.y, stack.u, plant.st
    told = u if len(plan) == 0 else kept[len(kept) - 1 :]
    delayed = plant_is_delayed(plant)
    for k in range(start, stop):
        changed, trips = False, 0
        plant_flows(plant, flows[k - first])
        for i in range(len(ctl)):
            before, changes, row = ctl[i].state, ctl[i].changes, plant_rows[i, k - first]
            tripped = sample(plant, i, y[i], row)
            trips += tripped
            mine, estimate = ctl[i : i + 1], est[i : i + 1]
            if not stands_still(plan, k):
                answer(mine, laws[i], states[i], estimate, y[i], u[i], tripped != 0)
            record_controller(controller_rows[i, k - first], mine, states[i], estimate)
            if len(plan) > 0:
                replay(plan, kept, k, u[i], told[i])
            record_command(row, told[i])
            changed = changed or ctl[i].changes != changes or ctl[i].state != before
        if delayed:  # as over a link, where u[k] may come meanwhile
            plant_step(plant)
        for i in range(len(ctl)):
            state = ctl[i].state
            if apply_peer_state(plant, i, survives_trip, state) != ReturnReason.GO_ON:
                return k + 1, False
            if take(plant, i, told[i], st[i].trip, state, True) != ReturnReason.GO_ON:
                return k + 1, False
        if not delayed:
            plant_step(plant)
        for i in range(len(ctl)):
            trips -= st[i].trip
            changed = asks_to_start(plant, i, ctl[i].state) or changed
        if changed or trips != 0 or plant.now[0].check > WATCHING:
            return k + 1, False
    return stop, True


def run_ticks(
    plant: PlantRecords,
    controllers: Stack,
    plant_rows: NDArray[np.float64],
    controller_rows: NDArray[np.float64],
    start: int,
    stop: int,
    first: int = 0,
    survives_trip: bool = False,
    trace: Trace | None = None,
    flows: NDArray[np.float64] | None = None,
) -> int:
    """Run ticks [start, stop); returns the tick after the last one done.

    Returns early, after recording the tick, when a law, a controller's state or a converter's
    protection changed, and before the plant takes u[k] when it has to be put back to its start.

    Args:
        plant, controllers: at tick ``start``.
        plant_rows, controller_rows: shape (N, ticks, columns), of every tick from ``first`` on,
            columns as ``signals_of`` says.
        survives_trip: the run does after a trip.
        trace: what the run replays, if anything.
        flows: of the network, (ticks, columns), likewise; None: nothing.
    """
    of_network = np.empty((plant_rows.shape[1], 0)) if flows is None else flows
    rows, more = (plant_rows, controller_rows, of_network), trace or no_trace()
    return int(_run_ticks(plant, controllers, *rows, start, stop, first, survives_trip, *more)[0])


def run_inproc(
    benches: Sequence[Bench],
    plant_parts: Sequence[RolePart | Kept],
    controller_parts: Sequence[RolePart | Kept],
    timelines: Sequence[Timeline],
    go_on: Callable[[int], bool],
) -> int:
    """Run a whole scenario: of each converter its bench, its parts of the recording, and its
    timeline. ``go_on`` gets the ticks done and returns whether to go on. Returns the ticks done."""
    bench, ticks, k = benches[0], benches[0].scenario.ticks, 0
    survives_trip, plant = bench.scenario.survives_trips, bench.plant.records
    chunk = max(_LEAST_CHUNK, CHUNK // len(benches))
    piece = max(_LEAST_PIECE, _PIECE // len(benches))
    controllers = stack(benches)
    plant_rows, controller_rows = rows(len(benches), piece, bench.inner, bench.options)
    flows = np.empty((piece, len(bench.flows)))
    sides = (plant_rows, plant_parts), (controller_rows, controller_parts)
    while k < ticks and any(timeline.running for timeline in timelines):
        for timeline in timelines:
            timeline.carry_out(k)
        stop, calm = min(k + chunk, ticks, *(timeline.next_tick() for timeline in timelines)), True
        while k < stop and calm:
            end = min(k + piece, stop)
            done, calm = _run_ticks(
                plant,
                controllers,
                plant_rows,
                controller_rows,
                flows,
                k,
                end,
                k,
                survives_trip,
                *bench.trace,
            )
            for room, parts in sides:
                for part, recorded in zip(parts, room, strict=True):
                    part.put(k, recorded[: done - k])
            plant_parts[0].put_flows(k, flows[: done - k])
            k = done
        if bench.plant.net[0]["joins"]:
            follow_trips(bench.plant)
        elif int(bench.plant.st["trip"][0]) and int(bench.controller.ctl["state"][0]) == READY:
            bench.restore_plant(k)
        report_check(bench.plant, timelines, k)
        for timeline in timelines:
            timeline.look(k - 1)
        if not go_on(k):
            for timeline in timelines:
                timeline.end("interrupted", "stopped by the operator", k)
    for timeline in timelines:
        timeline.finish(k)
    return k


def rows(
    converters: int, ticks: int, inner: int, options: tuple[str, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Room for what the loop records: of the plant and of the controllers, each of shape
    (converters, ticks, columns)."""
    plant, controller = (len(signals_of(role, inner, options)) for role in ("plant", "controller"))
    return np.empty((converters, ticks, plant)), np.empty((converters, ticks, controller))


def compile_loop(benches: Sequence[Bench]) -> None:
    """Compile (or load from cache) the loop without running a tick."""
    room = rows(len(benches), 1, benches[0].inner, benches[0].options)
    run_ticks(benches[0].plant.records, stack(benches), *room, 0, 0)
