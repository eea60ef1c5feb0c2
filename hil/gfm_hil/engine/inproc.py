"""Both sides in one process: the same tick functions in one compiled loop, in lockstep.

The result is bit for bit that of two processes over a link, because a frame carries float64 and
each tick calls the same functions in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.loop_records import ControllerRecords, ReturnReason
from gfm_hil.engine.parts import run_threads
from gfm_hil.engine.replay import Trace, no_trace, replay, stands_still
from gfm_hil.engine.setup import Bench, follow_trips
from gfm_hil.engine.tick import answer, apply_peer_state, asks_to_start, sample, take
from gfm_hil.engine.timeline import Timeline, report_check
from gfm_hil.realtime.atomics import prefetch, row_at
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.recording.parts import MemoryPart, RolePart
from gfm_hil.recording.recorder import record_command, record_controller
from gfm_plant import PlantRecords, plant_flows, plant_is_delayed, plant_step
from gfm_plant.layout import field
from gfm_plant.synchro_check import WATCHING
from gfm_runtime.assembly import Controller
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.controller import take_set_points
from gfm_runtime.states import READY

CHUNK = 10_000  # ticks of all converters between two looks at the stop flag and the progress bar
_PIECE = 1_000  # ticks of all converters that are recorded at a time, in the processor's cache
# the least of both in a network: Python handles each converter at the end of each
_LEAST_CHUNK, _LEAST_PIECE = 3_000, 100
_LINE = 64  # bytes of a line of the processor's cache


class Stack(NamedTuple):
    """The controllers of a plant, one below the other."""

    # their records: ctl and est of shape (N,), states of shape (N, laws), laws of (rows, laws)
    controllers: ControllerRecords
    row: NDArray[np.int64]  # of its laws, by converter, (N,): those of equal laws share one
    y: NDArray[np.float64]  # measurements of the current tick, (N, 5) or (N, 11), p.u.
    u: NDArray[np.float64]  # inputs of the current tick, (N, 3) or (N, 4), p.u.


def stack(benches: Sequence[Bench]) -> Stack:
    """The records of all benches in common arrays, of which each bench then has its part."""
    for b in benches:
        b.controller.find_inner_tick()
    if len(benches) == 1:
        (b,) = benches
        c = b.controller
        one = ControllerRecords(c.ctl, c.laws[None], c.states[None], c.est)
        return Stack(one, np.zeros(1, np.int64), b.y[None], b.u[None])
    all_c = [b.controller for b in benches]
    most = max(len(c.laws) for c in all_c)
    ctl, est = _below([c.ctl for c in all_c], 1), _below([c.est for c in all_c], 1)
    states = _below([c.states for c in all_c], most)
    laws, row = _share_laws(all_c, most)
    y, u = np.stack([b.y for b in benches]), np.stack([b.u for b in benches])
    for k, (b, c) in enumerate(zip(benches, all_c, strict=True)):
        n = len(c.laws)
        c.ctl, c.est, c.states = ctl[k], est[k], states[k, :n]
        b.y, b.u = y[k], u[k]
    return Stack(ControllerRecords(ctl[:, 0], laws, states, est[:, 0]), row, y, u)


def _share_laws(
    controllers: Sequence[Controller], most: int
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Laws of all controllers, equal ones once so that many stay in the processor's cache, and the
    row of each controller, which moves to one of its own before its gains change."""
    dtype, rows = controllers[0].laws.dtype, dict[bytes, int]()
    row = np.array([rows.setdefault(c.laws.tobytes(), len(rows)) for c in controllers])
    whole = np.zeros((len(rows) + len(controllers), most * dtype.itemsize), np.uint8)
    for content, k in rows.items():
        whole[k, : len(content)] = np.frombuffer(content, np.uint8)
    laws = whole.view(dtype)

    def move(c: Controller, k: int, to: int) -> None:
        whole[to] = whole[row[k]]
        row[k], c.laws = to, laws[to, : len(c.laws)]

    for k, c in enumerate(controllers):
        c.laws = laws[row[k], : len(c.laws)]
        c.before_retuning = partial(move, c, k, len(rows) + k)
    return laws, row


def _below(arrays: Sequence[NDArray[Any]], most: int) -> NDArray[Any]:
    """Arrays of records, each at most ``most`` long, one below the other; as bytes, since numpy
    takes a millisecond to copy a record of many fields by its fields."""
    dtype = arrays[0].dtype
    whole = np.zeros((len(arrays), most * dtype.itemsize), np.uint8)
    for room, array in zip(whole, arrays, strict=True):
        room[: array.nbytes] = np.ascontiguousarray(array).view(np.uint8)
    return whole.view(dtype)


class Places(NamedTuple):
    """Addresses of rows: of each converter's plant, (N,), and controller, and of the network."""

    plant: NDArray[np.int64]
    controller: NDArray[np.int64]
    flows: NDArray[np.int64]
    widths: NDArray[np.int64]  # how many columns each of them has, (3,)


def places(*rows: Iterable[NDArray[np.float64]]) -> Places:
    """Where rows are, (ticks, columns) each. Raises ValueError: not one after the other."""
    all_rows = [[*each] for each in rows]
    if not all(array.flags.c_contiguous for each in all_rows for array in each):
        raise ValueError("rows must follow each other without gaps")
    plant, controller, flows = (np.array([a.ctypes.data for a in each]) for each in all_rows)
    return Places(plant, controller, flows, np.array([each[0].shape[1] for each in all_rows]))


@inlined
def _fetch(at, width, k):
    """Fetch the lines of row k meanwhile, which are not in the processor's cache."""
    first = at + 8 * width * k
    for line in range(first, first + 8 * width, _LINE):
        prefetch(line)


@compiled
def _run_ticks(plant, stack, places, start, stop, first, survives_trip, plan, kept):
    """``run_ticks``; also whether every tick was done and left nothing to see to."""
    ctl, laws, states, est = stack.controllers
    y, u, st, widths = stack.y, stack.u, plant.st, places.widths
    told = u if len(plan) == 0 else kept[len(kept) - 1 :]
    delayed = plant_is_delayed(plant)
    for k in range(start, stop):
        changed, trips = False, 0
        plant_flows(plant, row_at(places.flows[0], widths[2], k - first))
        for i in range(len(ctl)):
            if i + 1 < len(ctl):
                _fetch(places.plant[i + 1], widths[0], k - first)
                _fetch(places.controller[i + 1], widths[1], k - first)
            before, changes = ctl[i].state, ctl[i].changes
            row = row_at(places.plant[i], widths[0], k - first)
            tripped = sample(plant, i, y[i], row)
            trips += tripped
            mine, estimate = ctl[i : i + 1], est[i : i + 1]
            if not stands_still(plan, k):
                if plant.net[0].followers > 0:
                    take_set_points(ctl[i], field(plant.now[0], "set_points")[i], 0)
                answer(mine, laws[stack.row[i]], states[i], estimate, y[i], u[i], tripped != 0)
            other = row_at(places.controller[i], widths[1], k - first)
            record_controller(other, mine, states[i], estimate)
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
            columns as ``ColumnSet.signals`` says.
        survives_trip: the run does after a trip.
        trace: what the run replays, if anything.
        flows: of the network, (ticks, columns), likewise; None: nothing.
    """
    of_network = np.empty((plant_rows.shape[1], 0)) if flows is None else flows
    where, more = places(plant_rows, controller_rows, [of_network]), trace or no_trace()
    return int(_run_ticks(plant, controllers, where, start, stop, first, survives_trip, *more)[0])


def run_inproc(
    benches: Sequence[Bench],
    plant_parts: Sequence[RolePart | MemoryPart],
    controller_parts: Sequence[RolePart | MemoryPart],
    timelines: Sequence[Timeline],
    go_on: Callable[[int], bool],
) -> int:
    """Run a whole scenario: of each converter its bench, its parts of the recording, and its
    timeline. ``go_on`` gets the ticks done and returns whether to go on. Returns the ticks done."""
    return drive(run_steps(Converters(benches, plant_parts, controller_parts, timelines), go_on))


def run_steps(whole: Converters, go_on: Callable[[int], bool] | None = None) -> Steps[int]:
    """``run_inproc`` step by step; None: nobody has to be asked."""
    benches, timelines = whole.benches, whole.timelines
    chunk = max(_LEAST_CHUNK, CHUNK // len(benches))

    def ask(k: int) -> bool:
        if go_on is not None and not go_on(k):
            for timeline in timelines:
                timeline.end("interrupted", "stopped by the operator", k)
        return any(timeline.running for timeline in timelines)

    if not any(timeline.running for timeline in timelines):
        k = 0
    elif benches[0].scenario.cores is None:
        k = yield from _run_plant(whole, chunk, ask, is_asked=go_on is not None)
    else:
        k = _run_parts(whole, benches[0].scenario.cores, chunk, ask)
    for timeline in timelines:
        timeline.finish(k)
    return k


class Converters(NamedTuple):
    """The converters of a run, or of a part of its plant."""

    benches: Sequence[Bench]
    plant_parts: Sequence[RolePart | MemoryPart]
    controller_parts: Sequence[RolePart | MemoryPart]
    timelines: Sequence[Timeline]


class Stretch(NamedTuple):
    """The ticks [start, stop) of a run, in which no event is due."""

    those: Converters
    start: int
    stop: int


T = TypeVar("T")
#: a run that does the first tick of each stretch, and is then told to which tick someone else has
#: taken it; the rest of the stretch it does itself
Steps = Generator[Stretch, int, T]


def drive(run: Steps[T]) -> T:
    """Have a run do all its ticks itself."""
    try:
        stretch = next(run)
        while True:
            stretch = run.send(stretch.start)
    except StopIteration as end:
        return cast(T, end.value)


class FlowsOfPart(NamedTuple):
    """What a part of the plant records of the network."""

    rows: NDArray[np.float64]  # those of the whole network, (ticks, columns)
    columns: list[int]  # which of these

    @staticmethod
    def put_to(flows: NDArray[np.float64], k: int, here: Places) -> Places:
        """Return ``here`` with the network's rows in ``flows``, (ticks, columns), which begins with
        tick k."""
        begin = flows.ctypes.data - k * flows.strides[0]
        widths = np.array([*here.widths[:2], flows.shape[1]])
        return here._replace(flows=np.array([begin]), widths=widths)


def _run_plant(
    those: Converters,
    chunk: int,
    ask: Callable[[int], bool],
    of_part: FlowsOfPart | None = None,
    is_asked: bool = True,
) -> Steps[int]:
    """Run the converters of one plant; returns the ticks done.

    Args:
        chunk: a multiple of it ends each stretch, if nothing else does.
        ask: whether to go on after so many ticks.
        of_part: of a part of the plant, which columns of the network it records.
        is_asked: at each multiple of ``chunk``, and not only where else a stretch ends.
    """
    benches, plant_parts, controller_parts, timelines = those
    bench, ticks, k = benches[0], benches[0].scenario.ticks, 0
    survives_trip, plant = bench.scenario.survives_trips, bench.plant.records
    controllers = stack(benches)
    piece = max(_LEAST_PIECE, _PIECE // len(benches))
    where = _where_they_stay(plant_parts, controller_parts)
    plant_rows, controller_rows = rows(len(benches), piece, bench.columns)
    flows = np.empty((piece, len(of_part.columns if of_part else bench.columns.flows)))
    here = where or places(plant_rows, controller_rows, [flows])
    if of_part is not None:
        here = of_part.put_to(flows, 0, here)
    going = True
    while k < ticks and going:
        for timeline in timelines:
            timeline.carry_out(k)
        stop = min(ticks, *(timeline.next_tick() for timeline in timelines))
        if is_asked:
            stop = min(stop, k + chunk - k % chunk)
        calm, begun = True, k + 1  # by which all that an event has changed is known
        while k < stop and calm:
            end, first = (stop, 0) if where else (min(k + piece, stop), k)
            if k < begun:
                end = min(end, begun)
            if of_part is not None and of_part.columns:
                end, here = min(k + piece, stop), of_part.put_to(flows, k, here)
            done, calm = _run_ticks(
                plant, controllers, here, k, end, first, survives_trip, *bench.trace
            )
            if where is None:
                _put(k, plant_parts, plant_rows[:, : done - k], flows[: done - k])
                _put(k, controller_parts, controller_rows[:, : done - k], flows[:0])
            if of_part is not None and of_part.columns:
                of_part.rows[k:done, of_part.columns] = flows[: done - k]
            k = done
            if k == begun and calm and k < stop:
                k = yield Stretch(those, k, stop)
                begun = k + chunk
        if bench.plant.net[0]["joins"]:
            follow_trips(bench.plant)
        elif int(bench.plant.st["trip"][0]) and int(bench.controller.ctl["state"][0]) == READY:
            bench.restore_plant(k)
        report_check(bench.plant, timelines, k)
        for timeline in timelines:
            timeline.look(k - 1)
        going = ask(k)
    return k


def _run_parts(whole: Converters, cores: int, chunk: int, ask: Callable[[int], bool]) -> int:
    """``_run_plant`` of all parts of a plant, a thread each, on some processor cores."""
    names, flow_rows = whole.benches[0].columns.flows, whole.plant_parts[0].flows
    parts = dict[int, list[int]]()
    for k, bench in enumerate(whole.benches):
        parts.setdefault(id(bench.plant), []).append(k)
    each = [
        Converters(
            [whole.benches[k] for k in places],
            [whole.plant_parts[k] for k in places],
            [whole.controller_parts[k] for k in places],
            [whole.timelines[k] for k in places],
        )
        for places in parts.values()
    ]

    def run(p: int, go_on: Callable[[int], bool]) -> int:
        recorded = each[p].benches[0].plant.wiring.recorded
        columns = [names.index(name) for one in recorded for name in one.columns]
        return drive(_run_plant(each[p], chunk, go_on, FlowsOfPart(flow_rows, columns)))

    def meets(k: int) -> bool:
        return k % chunk == 0 or k == whole.benches[0].scenario.ticks

    return run_threads([one.benches[0].plant for one in each], cores, run, meets, ask)


def _put(
    first: int,
    parts: Sequence[RolePart | MemoryPart],
    rows: NDArray[np.float64],
    flows: NDArray[np.float64],
) -> None:
    """Put rows into those parts that take them."""
    for part, own in zip(parts, rows, strict=True):
        if isinstance(part, MemoryPart):
            part.put(first, own, flows)


def _where_they_stay(
    plant_parts: Sequence[RolePart | MemoryPart], controller_parts: Sequence[RolePart | MemoryPart]
) -> Places | None:
    """The places of the rows of all ticks in the parts; None if one takes them by ``put``."""
    sides = [[part.signals for part in parts] for parts in (plant_parts, controller_parts)]
    own = [[rows for rows in each if rows is not None] for each in sides]
    if list(map(len, own)) != list(map(len, sides)):
        return None
    return places(*own, [plant_parts[0].flows])


def rows(
    converters: int, ticks: int, columns: ColumnSet
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Room for what the loop records: of the plant and of the controllers, each of shape
    (converters, ticks, columns)."""
    plant, controller = (len(columns.signals(role)) for role in ("plant", "controller"))
    return np.empty((converters, ticks, plant)), np.empty((converters, ticks, controller))


def compile_loop(benches: Sequence[Bench]) -> None:
    """Compile (or load from cache) the loop without running a tick."""
    room = rows(len(benches), 1, benches[0].columns)
    run_ticks(benches[0].plant.typed, stack(benches), *room, 0, 0)
