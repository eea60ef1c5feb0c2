"""The closed loop over every link, with the product itself: two processes, a complete run; and in
one process, with its parts.

Lockstep: ticks per second, compared with the limit of the plant's arithmetic alone. Real time:
ticks without a fresh u, their causes, and how many ticks a loop that only paces lost on the same
machine right before and after.
"""

import itertools
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from numba.core.runtime import _nrt_python  # type: ignore[attr-defined]
from numba.core.runtime.nrt import rtsys

from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.cpu_load import cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.jitter import lost, pace_both, pace_here
from gfm_hil.bench.options import BenchOptions
from gfm_hil.bench.pair import pair
from gfm_hil.bench.pingpong import HYBRID
from gfm_hil.bench.rounds import RUNS, ShowProgress, in_turn, quickest, seconds, spread, take_turns
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.engine.inproc import run_ticks, stack
from gfm_hil.engine.setup import make_bench
from gfm_hil.links import link_kind, open_link
from gfm_hil.recording.parts import RolePart
from gfm_hil.recording.recorder import record_command, record_controller, record_sample
from gfm_hil.run.attribution import OURS, Times, attribute, bursts, counts, missed_ticks
from gfm_hil.run.processor_time import ProcessorTime
from gfm_hil.run.runner import run_scenario
from gfm_hil.run.stalls import ProcessorWatch, loops_of
from gfm_hil.scenario import INPROC, Scenario, check_scenario, load_scenario
from gfm_plant import plant_advance, plant_sample
from gfm_runtime.compiled import compiled
from gfm_runtime.controller import control
from gfm_runtime.signals import NU, NY

LAW = "mimo-gfm"
T_S = 1e-4  # s
_T_NS = round(T_S * 1e9)
_SETTLE = 1_000  # ticks left out after the start of the CPU load
_PATIENCE_S = 5.0  # peer timeout: a busy machine must not end a run
_SHORT = 2_000  # ticks of one of the short runs in process
# Laws whose defaults are stable on the paper's stiff grid; the last row adds the rig's noise,
# sensor filters, quantisation and delay.
LAWS = (
    "mimo-gfm", "mimo-gfm-scheduled", "vsg-2", "vsg-11", "droop-2", "droop-5", "psc-2",
    "matching-1", "hybrid-angle",
)  # fmt: skip
RIG = "mimo-gfm, rig"

Beside = Callable[[], AbstractContextManager[None]]


@dataclass
class _Run:
    """A run, and in real time the bare loop before and after it."""

    # columns of timing.npz, without the ticks before the CPU load has settled
    timing: dict[str, Times]
    scheduling: list[str]  # of the two sides
    early: str  # why it ended early; empty if it did not
    taken: ProcessorTime | None  # who had the processors
    processors: list[int]  # of the two sides
    late: Times | None = None  # of the bare loop, (2, ticks), ns


def measure(options: BenchOptions, content: dict[str, Any], show: ShowProgress) -> None:
    """Add rows to ``lockstep``, ``laws`` and ``realtime`` of ``loop``, those of the modes."""
    loop: dict[str, Any] = content.setdefault("loop", {})
    remarks: list[str] = []
    show("trying the links", 0.0)
    links = [link for link in options.links if _works(link, remarks)]
    if "lockstep" in options.modes:
        with ExitStack() as stack:
            place = memory_folder(stack)
            loop["laws"] = list(measure_laws(options.laws, options.rounds, place, show))
        loop["lockstep"] = _lockstep(links, options, show, remarks)
    if "realtime" in options.modes:
        loop["realtime"] = _realtime(links, options, show, remarks)
    content["remarks"] += [one for one in remarks if one not in content["remarks"]]


def _works(link: str, remarks: list[str]) -> bool:
    """Whether a link works here at ``T_S``; a remark if it does not."""
    try:
        options = _scenario(link, "lockstep", T_S).link.options
        with ExitStack() as stack:
            endpoint = link_kind(link).fresh(memory_folder(stack))
            open_link(link, "controller", endpoint, options).close()
    except UserError as problem:
        remarks.append(f"{link}, closed loop: not measured: {problem}")
        return False
    return True


def _lockstep(
    links: Sequence[str], options: BenchOptions, show: ShowProgress, remarks: list[str]
) -> list[dict[str, Any]]:
    """Ticks per second over every link and in process; simulated, so as fast as possible.

    Over a link it measures with and without one sample of loop delay: with it, as in a real loop,
    the plant continues while u[k] is on its way. The share of the limit of the plant's half alone
    compares the fastest stretches of both. The half is timed right before and after, in at least
    as many stretches, so that neither a stop of the machine nor a change of its speed counts.
    """
    loops = [(INPROC, 0), *product(links, (0, 1))]
    rates, shares = ({loop: list[float]() for loop in loops} for _ in range(2))
    ticks = round(options.seconds / T_S)
    with ExitStack() as stack:
        place = memory_folder(stack)
        alone = InprocLoop("pref_step", LAW, _SHORT, place / "inproc")
        half = partial(quickest, partial(alone.part, "plant's half"), max(RUNS, ticks // _SHORT))
        for _, share, (link, delay) in in_turn(loops, options.rounds, options.until):
            before_ns = half()
            show(f"lockstep, {link}", share)
            if link == INPROC:
                stretches = [alone.whole() for _ in range(RUNS)]
                tick_ns = fmean(stretches)
            else:
                run = _run(_scenario(link, "lockstep", options.seconds, delay), place)
                if run.early:
                    remarks.append(f"{link}, lockstep: a run ended early: {run.early}")
                    continue
                tick_ns, stretches = _pace(run.timing["plant_sent"])
            rates[link, delay].append(1e9 / tick_ns)
            shares[link, delay].append(min(before_ns, half()) / min(stretches))
    return [
        {
            "link": link,
            "delay_samples": delay,
            "mode": "lockstep",
            "ticks_per_s": spread(rate),
            "times_real_time": spread([each * T_S for each in rate]),
            "share_of_plant_alone": spread(shares[link, delay]),
        }
        for (link, delay), rate in rates.items()
        if rate
    ]


def _pace(sent: Times) -> tuple[float, list[float]]:
    """ns per tick, of the whole run and of each stretch of ``_SHORT`` ticks."""
    marks = sent[:: min(_SHORT, len(sent) - 1)]
    whole = float(sent[-1] - sent[0]) / (len(sent) - 1)
    return whole, (np.diff(marks) / min(_SHORT, len(sent) - 1)).tolist()


def _realtime(
    links: Sequence[str], options: BenchOptions, show: ShowProgress, remarks: list[str]
) -> list[dict[str, Any]]:
    """Misses at 10 kHz in real time over every link under every load."""
    cells = list(product(links, options.loads))
    runs = {cell: list[_Run]() for cell in cells}
    with ExitStack() as stack:
        place = memory_folder(stack)
        load_is = stack.enter_context(cpu_load())
        two = stack.enter_context(pair(options.policies[0], place))
        two.both(pace_here, 0, 1, HYBRID, 1)
        for _, share, (link, load) in in_turn(cells, options.rounds, options.until):
            show(f"real time, {link}, {load}", share)
            # one half before and one after, so that a slow change of the host's load affects both
            half = options.seconds / 2
            with load_is(load):
                before = pace_both(two, _T_NS, HYBRID, half)
            beside = partial(load_is, load) if load != "idle" else nullcontext
            run = _run(_scenario(link, "realtime", options.seconds), place, beside)
            with load_is(load):
                run.late = np.concatenate([before, pace_both(two, _T_NS, HYBRID, half)], axis=1)
            if run.early:
                remarks.append(f"{link}, real time, {load}: a run ended early: {run.early}")
            if "plant_received" in run.timing:
                runs[link, load].append(run)
    return [_row(*cell, some) for cell, some in runs.items() if some]


def _row(link: str, load: str, runs: list[_Run]) -> dict[str, Any]:
    trips, missed, beyond = list[Times](), list[Times](), list[float]()
    ticks = host = host_ticks = 0
    causes, names = Counter[str](), Counter[str]()
    for run in runs:
        assert run.late is not None
        sent, received = run.timing["plant_sent"], run.timing["plant_received"]
        trip = (received - sent)[received >= 0]
        trips.append(trip)
        missed.append(missed_ticks(run.timing))
        ticks += len(sent)
        why = attribute(run.timing, _T_NS, (), run.taken, run.processors)
        causes.update(counts(why.causes))
        names.update(filter(None, why.names))
        usual = float(np.median(trip)) if len(trip) else 0.0
        alone = len(lost(run.late, _T_NS - usual))
        host += alone
        host_ticks += run.late.shape[1]
        if len(sent):
            beyond.append(100 * (len(missed[-1]) / len(sent) - alone / run.late.shape[1]))
    count, ours = sum(map(len, missed)), sum(causes[cause] for cause in OURS)
    return {
        "link": link,
        "mode": "realtime",
        "load": load,
        "policy": runs[0].scheduling,
        "T_s_us": T_S * 1e6,
        "ticks": ticks,
        "missed": count,
        "missed_pct": _percent(count, ticks),
        "host_pct": _percent(host, host_ticks),
        # the median: one long stop of the machine in a run, or in the pacing, is an outlier
        "beyond_host_pct": round(median(beyond), 4) if beyond else None,
        "rounds_beyond_host_pct": [round(value, 4) for value in beyond],
        "by_work_or_link_pct": _percent(ours, ticks),
        "causes": dict(causes),
        "names": dict(names.most_common()),
        "method": runs[0].taken.method if runs[0].taken else None,
        "bursts": bursts(missed),
        **summary(trips),
    }


def _percent(count: int, of: int) -> float | None:
    return round(100 * count / of, 4) if of else None


def _scenario(link: str, mode: str, duration: float, delay: int = 0) -> Scenario:
    content = {
        "title": f"bench, {link}", "duration": duration, "T_s": T_S, "mode": mode, "law": LAW,
        "plant": {"delay": {"samples": delay}},
        "link": {"type": link, "peer_timeout_s": _PATIENCE_S},
        "late_policy": {"hold": 10**9},  # count misses, never end the run
    }  # fmt: skip
    return check_scenario(content, "bench")


def _run(scenario: Scenario, place: Path, beside: Beside = nullcontext) -> _Run:
    """Run a scenario; in real time, the context ``beside`` and the watch over the processors begin
    with its first ticks, not while it starts."""
    folder, begin = place / f"run-{time.monotonic_ns()}", 0
    with ExitStack() as during, ProcessorWatch() as watch:

        def progress(ticks: int, misses: int) -> None:
            nonlocal begin
            if ticks and not begin and scenario.mode == "realtime":
                watch.begin(loops_of(folder))
                during.enter_context(beside())
                begin = ticks + _SETTLE

        run = run_scenario(scenario, folder, progress)
    if run.status == "interrupted":  # the run has caught Ctrl-C
        raise KeyboardInterrupt
    timing = {name: np.array(column[begin:]) for name, column in run.timing.items()}
    policies = [f"{e['role']}: {e['policy']}" for e in run.events if e["event"] == "scheduling"]
    early = ""
    if run.status != "completed":
        logs = (log for role in ROLES if (log := folder / f"{role}.log").exists())
        ends = dict.fromkeys(log.read_text("utf-8").strip().splitlines()[-1] for log in logs)
        early = f"{run.status} {' / '.join(filter(None, ends)) or run.summary['reason']}".strip()
    shutil.rmtree(folder)
    return _Run(timing, policies, early, watch.taken, [*watch.loops])


@compiled
def plant_alone(plant, y, u, us):
    """The plant under the recorded commands ``us`` (ticks, 3)."""
    for k in range(len(us)):
        for i in range(NU):
            u[i] = us[k, i]
        plant_sample(plant, 0, y)
        plant_advance(plant, u)


@compiled
def plants_half(plant, y, u, us, rows):
    """The tick of the plant's process without the link: the plant and its recording."""
    for k in range(len(us)):
        for i in range(NU):
            u[i] = us[k, i]
        plant_sample(plant, 0, y)
        record_sample(rows[k], y, plant, 0)
        record_command(rows[k], u)
        plant_advance(plant, u)


@compiled
def controller_alone(ctl, laws, states, est, y, u, ys):
    """The controller on the recorded measurements ``ys`` (ticks, 5)."""
    for k in range(len(ys)):
        for j in range(NY):
            y[j] = ys[k, j]
        control(ctl, laws, states, est, y, u)


@compiled
def recording_alone(plant, ctl, states, est, y, u, plant_rows, controller_rows):
    """Record the same tick into every row."""
    for k in range(len(plant_rows)):
        record_controller(controller_rows[k], ctl, states, est)
        record_sample(plant_rows[k], y, plant, 0)
        record_command(plant_rows[k], u)


class InprocLoop:
    """A bench that can be reset to its start, and files for its recording.

    What measures returns ns per tick.
    """

    def __init__(self, scenario: str, law: str, ticks: int, folder: Path) -> None:
        b = make_bench(load_scenario(scenario, law=law, in_process=True))
        b.controller.set("P_ref", 0.8)
        b.controller.find_inner_tick()
        self.bench, self.ticks, self.T_s = b, ticks, b.scenario.T_s
        plant, controller = self._rows = [
            RolePart.create(folder, role, ticks).signals for role in ("plant", "controller")
        ]
        # as in a run, rows that were not written lately
        fresh = RolePart.create(folder / "long", "plant", RUNS * ticks).signals
        self._fresh = itertools.cycle(np.split(fresh, RUNS))
        ctl, *more = b.controller.ctl, b.controller.laws, b.controller.states, b.controller.est
        records, out = b.plant.records, (b.y, b.u)  # first: its memory has what it calls
        self._kept = [*b.plant.memory, ctl, *more, *out]
        self._start = [a.copy() for a in self._kept]
        self.whole()
        y, u = np.split(plant[:, : NY + NU].copy(), [NY], axis=1)
        self._parts: dict[str, Callable[[], object]] = {
            "plant": lambda: plant_alone(records, *out, u),
            "controller": lambda: controller_alone(ctl, *more, *out, y),
            "recording": lambda: recording_alone(records, ctl, *more[1:], *out, plant, controller),
            "plant's half": lambda: plants_half(records, *out, u, self._row),
        }

    def _reset(self) -> None:
        for array, start in zip(self._kept, self._start, strict=True):
            array[:] = start
        self._row = next(self._fresh)

    def whole(self, ticks: int | None = None) -> float:
        """The closed loop. Raises UserError: the run ended early, so that there is nothing to
        time."""
        self._reset()
        b, n = self.bench, ticks or self.ticks
        done, controllers = 0, stack([b])
        plant, controller = self._rows

        def run() -> None:
            nonlocal done
            done = run_ticks(b.plant.records, controllers, plant[None], controller[None], 0, n)

        time = seconds(run) / n * 1e9
        if done != n:
            raise UserError(f"{b.controller.active}: tripped or safe at tick {done - 1} of {n}")
        return time

    def part(self, name: str) -> float:
        """The plant, the controller or the recording alone, or the plant's half: the plant and its
        recording."""
        self._reset()
        return seconds(self._parts[name]) / self.ticks * 1e9

    def allocations_per_tick(self) -> float:
        """Allocations of numba's runtime per tick; those per call cancel."""

        def allocations(ticks: int) -> int:
            before = rtsys.get_allocation_stats().alloc
            self.whole(ticks)
            return int(rtsys.get_allocation_stats().alloc - before)

        _nrt_python.memsys_enable_stats()
        short, long = allocations(self.ticks // 2), allocations(self.ticks)
        _nrt_python.memsys_disable_stats()
        return (long - short) / (self.ticks - self.ticks // 2)


def measure_laws(
    laws: Sequence[str], rounds: int, folder: Path, show: ShowProgress
) -> Iterator[dict[str, Any]]:
    """ns per tick of laws and of the rig, one row each; ``folder`` is for the recordings. Raises
    UserError: a run ended early, so that there is nothing to time."""
    runs = {name: ("pref_step", name) for name in laws or LAWS}
    runs[RIG] = ("rig_pref_step", "mimo-gfm")
    for k, (name, (scenario, law)) in enumerate(runs.items()):
        show(f"loop in process, {name}", k / len(runs))
        loop = InprocLoop(scenario, law, _SHORT, folder / name)
        parts: dict[str, Callable[[], float]] = {"whole": loop.whole}
        parts |= {n: partial(loop.part, n) for n in ("plant", "controller", "recording")}
        times = take_turns({n: partial(quickest, part) for n, part in parts.items()}, rounds)
        yield {
            "law": name,
            **{f"{part}_ns": spread(ns) for part, ns in times.items()},
            "times_real_time": spread([loop.T_s * 1e9 / ns for ns in times["whole"]]),
            "allocations_per_tick": loop.allocations_per_tick(),
        }
