"""The closed loop over every link, with the product itself: two processes, a complete run.

Lockstep: ticks per second, compared with the limit of the plant's arithmetic alone. Real time:
ticks without a fresh u, their causes, and how many ticks a loop that only paces lost on the same
machine right before and after.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.attribution import OURS, attribute, bursts, counts, missed_ticks
from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.cpu_load import Load, cpu_load
from gfm_hil.bench.histogram import summary
from gfm_hil.bench.inproc_loop import Loop
from gfm_hil.bench.jitter import HYBRID, lost, pace_both, pace_here
from gfm_hil.bench.pair import pair
from gfm_hil.bench.rounds import RUNS, Plan, Spread, quickest, rounds
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.engine.processes import Progress
from gfm_hil.links import link_kind, open_link
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import INPROC, Scenario, check_scenario

LAW = "mimo-gfm"
T_S = 1e-4  # s
_SETTLE = 1_000  # ticks left out after the start of the CPU load
_PATIENCE_S = 5.0  # peer timeout: a busy machine must not end a run
_SHORT = 2_000  # ticks of one of the short runs in process

COMPLETED = "completed"

Tell = Callable[[str, float], None]
Found = tuple[list[dict[str, Any]], list[str]]  # rows and remarks
Timing = dict[str, NDArray[np.int64]]


@dataclass
class _Run:
    """Results of one run in real time, and of the bare loop before and after it."""

    timing: Timing
    begin: int  # first tick that counts
    scheduling: list[str]
    ended: str
    late: NDArray[np.int64]


@dataclass
class _Cell:
    """One link in real time under one load."""

    link: str
    load: Load
    runs: list[_Run] = field(default_factory=list)


def usable(links: Sequence[str]) -> tuple[list[str], list[str]]:
    """The links that work here at ``T_S``, and a remark on each of the others."""
    found, remarks = [], []
    for link in links:
        try:
            scenario = _scenario(link, "lockstep", T_S)
            with ExitStack() as stack:
                endpoint = link_kind(link).fresh(memory_folder(stack))
                open_link(link, "controller", endpoint, scenario.link.options).close()
        except UserError as problem:
            remarks.append(f"{link}, closed loop: not measured: {problem}")
        else:
            found.append(link)
    return found, remarks


def measure_lockstep(plan: Plan, tell: Tell) -> Found:
    """Ticks per second over every link and in process; simulated, so as fast as possible.

    Over a link it measures with and without one sample of loop delay: with it, as in a real loop,
    the plant continues while u[k] is on its way. The share of the limit of the plant's half alone
    compares the fastest stretches of both. The half is timed right before and after, in at least
    as many stretches, so that neither a stop of the machine nor a change of its speed counts.
    """
    remarks: list[str] = []
    names = [(INPROC, 0), *((link, delay) for link in plan.links for delay in (0, 1))]
    rates: dict[tuple[str, int], list[float]] = {name: [] for name in names}
    shares: dict[tuple[str, int], list[float]] = {name: [] for name in names}
    ticks = round(plan.seconds / T_S)
    with ExitStack() as stack:
        place = memory_folder(stack)
        alone = Loop("pref_step", LAW, _SHORT, place / "inproc")
        half = partial(quickest, alone.plants_half, max(RUNS, ticks // _SHORT))
        for number in rounds(plan.rounds, plan.until):
            for k, name in enumerate(names[:: -1 if number % 2 else 1]):
                link, delay = name
                half_ns = half()
                tell(f"lockstep, {link}", (number + k / len(names)) / plan.rounds)
                if link == INPROC:
                    stretches = [alone.whole() for _ in range(RUNS)]
                    tick_ns = fmean(stretches)
                else:
                    scenario = _scenario(link, "lockstep", plan.seconds, delay)
                    timing, _, ended = _run(scenario, place)
                    if ended != COMPLETED:
                        remarks.append(f"{link}, lockstep: a run ended early: {ended}")
                        continue
                    tick_ns, stretches = _pace(timing["plant_sent"])
                half_ns = min(half_ns, half())
                rates[name].append(1e9 / tick_ns)
                shares[name].append(half_ns / min(stretches))
    rows = [
        {
            "link": name[0],
            "delay_samples": name[1],
            "mode": "lockstep",
            "ticks_per_s": Spread.of(rates[name]).plain(),
            "times_real_time": Spread.of([rate * T_S for rate in rates[name]]).plain(),
            "share_of_plant_alone": Spread.of(shares[name]).plain(),
        }
        for name in names
        if rates[name]
    ]
    return rows, remarks


def _pace(sent: NDArray[np.int64]) -> tuple[float, list[float]]:
    """ns per tick, of the whole run and of each stretch of ``_SHORT`` ticks."""
    marks = sent[:: min(_SHORT, len(sent) - 1)]
    whole = float(sent[-1] - sent[0]) / (len(sent) - 1)
    return whole, (np.diff(marks) / min(_SHORT, len(sent) - 1)).tolist()


def measure_realtime(plan: Plan, tell: Tell) -> Found:
    """Misses at 10 kHz in real time over every link under every load."""
    cells = [_Cell(link, load) for link in plan.links for load in plan.loads]
    with ExitStack() as stack:
        place = memory_folder(stack)
        load_is = stack.enter_context(cpu_load())
        two = stack.enter_context(pair(plan.policies[0], place))
        two.both(pace_here, 0, 1, HYBRID, 1)
        for number in rounds(plan.rounds, plan.until):
            for k, cell in enumerate(cells[:: -1 if number % 2 else 1]):
                share = (number + k / len(cells)) / plan.rounds
                tell(f"real time, {cell.link}, {cell.load}", share)

                def pace(load: Load = cell.load) -> NDArray[np.int64]:
                    with load_is(load):
                        return pace_both(two, round(T_S * 1e9), HYBRID, plan.seconds / 2)

                scenario = _scenario(cell.link, "realtime", plan.seconds)
                beside = partial(load_is, cell.load) if cell.load != "idle" else None
                cell.runs.append(_observe(scenario, place, pace, beside))
    remarks = [
        f"{cell.link}, real time, {cell.load}: a run ended early: {run.ended}"
        for cell in cells
        for run in cell.runs
        if run.ended != COMPLETED
    ]
    for cell in cells:
        cell.runs = [run for run in cell.runs if "plant_received" in run.timing]
    return [_row(cell) for cell in cells if cell.runs], remarks


def _observe(
    scenario: Scenario,
    place: Path,
    pace: Callable[[], NDArray[np.int64]],
    beside: Callable[[], AbstractContextManager[None]] | None,
) -> _Run:
    """One run in real time between two halves of a bare loop, so that a slow change of the host's
    load affects both; ``beside`` begins with the run's first ticks, not during its start."""
    begin, before = 0, pace()
    with ExitStack() as during:

        def progress(ticks: int, misses: int) -> None:
            nonlocal begin
            if ticks and not begin and beside is not None:
                during.enter_context(beside())
                begin = ticks + _SETTLE

        timing, scheduling, ended = _run(scenario, place, progress)
    return _Run(timing, begin, scheduling, ended, np.concatenate([before, pace()], axis=1))


def _row(cell: _Cell) -> dict[str, Any]:
    T_ns = round(T_S * 1e9)
    trips: list[NDArray[np.int64]] = []
    missed = ticks = host = host_ticks = 0
    beyond: list[float] = []
    causes, lengths = Counter[str](), Counter[int]()
    for run in cell.runs:
        timing = {name: column[run.begin :] for name, column in run.timing.items()}
        there = timing["plant_received"] >= 0
        trip = (timing["plant_received"] - timing["plant_sent"])[there]
        trips.append(trip)
        gone = missed_ticks(timing)
        missed += len(gone)
        ticks += len(there)
        causes.update(counts(attribute(timing, T_ns)))
        lengths.update(bursts(gone))
        allowed = T_ns - (float(np.median(trip)) if len(trip) else 0.0)
        alone = len(lost(run.late, allowed))
        host += alone
        host_ticks += run.late.shape[1]
        if len(there):
            beyond.append(100 * (len(gone) / len(there) - alone / run.late.shape[1]))
    ours = sum(causes[cause] for cause in OURS)
    return {
        "link": cell.link,
        "mode": "realtime",
        "load": cell.load,
        "policy": cell.runs[0].scheduling,
        "T_s_us": T_S * 1e6,
        "ticks": ticks,
        "missed": missed,
        "missed_pct": round(100 * missed / ticks, 4) if ticks else None,
        "host_pct": round(100 * host / host_ticks, 4),
        # the median: one long stop of the machine in a run, or in the pacing, is an outlier
        "beyond_host_pct": round(median(beyond), 4) if beyond else None,
        "rounds_beyond_host_pct": [round(value, 4) for value in beyond],
        "by_work_or_link_pct": round(100 * ours / ticks, 4) if ticks else None,
        "causes": dict(causes),
        "bursts": sorted(lengths.items()),
        **summary(trips),
    }


def _scenario(link: str, mode: str, duration: float, delay: int = 0) -> Scenario:
    content = {
        "title": f"bench, {link}",
        "duration": duration,
        "T_s": T_S,
        "mode": mode,
        "law": LAW,
        "plant": {"delay": {"samples": delay}},
        "link": {"type": link, "peer_timeout_s": _PATIENCE_S},
        "late_policy": {"hold": 10**9},  # count misses, never end the run
    }
    return check_scenario(content, "bench")


def _run(
    scenario: Scenario, place: Path, progress: Progress = lambda ticks, misses: None
) -> tuple[Timing, list[str], str]:
    """Run a scenario; returns its timing, the scheduling of its sides, and how it ended."""
    folder = place / f"run-{time.monotonic_ns()}"
    summary = run_scenario(scenario, folder, progress).summary
    if summary["status"] == "interrupted":  # the run has caught Ctrl-C
        raise KeyboardInterrupt
    with np.load(folder / "timing.npz") as file:
        timing = dict(file)
    log = [json.loads(line) for line in (folder / "events.jsonl").read_text("utf-8").splitlines()]
    said = [_last_line(folder / f"{role}.log") for role in ROLES]
    policies = [f"{e['role']}: {e['policy']}" for e in log if e["event"] == "scheduling"]
    shutil.rmtree(folder)
    why = " / ".join(dict.fromkeys(filter(None, said))) or summary["reason"]
    return timing, policies, " ".join(filter(None, (summary["status"], why)))


def _last_line(log: Path) -> str:
    """The last line of a failed side's log."""
    return log.read_text("utf-8").strip().splitlines()[-1] if log.exists() else ""
