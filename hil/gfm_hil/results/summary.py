"""summary.json: how a run ended and what it showed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.log import Outcome
from gfm_hil.results.metrics import Rows, blocks, event_metrics
from gfm_hil.scenario.expectation import unmet
from gfm_hil.scenario.model import Scenario
from gfm_plant import load_converter

_BLOCKS = 20  # of a run, whose earliest arrivals tell the drift of its clocks


def nominal_frequency(scenario: Scenario) -> float:
    """Nominal frequency of the scenario's converter, Hz."""
    return load_converter(scenario.plant.converter).bases.omega_b / (2 * np.pi)


def summarise(
    scenario: Scenario,
    signals: Mapping[str, Rows],
    timing: Mapping[str, Rows],
    log: list[dict[str, Any]],
    outcome: Outcome,
    faults: dict[str, dict[str, int]],
    wall_s: float,
    one_clock: bool = True,
) -> dict[str, Any]:
    """The summary of one run as plain data.

    ``signals`` and ``timing`` are the columns of the files of these names, shape (ticks,): arrays,
    or columns of a file, which are read piece by piece.
    """
    done = len(signals["tick"])
    changes = [e for e in log if e["event"] == "law-active"]
    happened = [e for e in log if "label" in e]
    bumps = {e["tick"]: e["bump_pu"] for e in changes}
    starts = np.array([e["tick"] for e in happened])  # in order, as the log is
    ends = [*np.searchsorted(starts, starts, side="right").tolist()]
    f_n = nominal_frequency(scenario)
    events = []
    for k, e in enumerate(happened):
        stop = int(starts[ends[k]]) if ends[k] < len(starts) else done
        entry = {"t": e["t"], "tick": e["tick"], "type": e["event"], "label": e["label"]}
        if e["event"] == "law":
            entry["bump_pu"] = bumps.get(e["tick"])
        if "true_p" in signals:
            entry.update(event_metrics(signals, e["tick"], min(stop, done), scenario.T_s, f_n))
        events.append(entry)
    summary = {
        "title": scenario.title,
        "status": outcome.status,
        "reason": outcome.reason,
        "expected": scenario.expect,
        "unmet": unmet(scenario, outcome, log, done),
        "laws": [scenario.law, *[e["law"] for e in changes]],
        "link": scenario.link.type,
        "mode": scenario.mode,
        "T_s": scenario.T_s,
        "ticks": done,
        "duration_s": done * scenario.T_s,
        "wall_s": wall_s,
        "misses": misses(timing, done),
        "round_trip_us": round_trip(timing),
        "faults": faults,
        "bump_pu": [e["bump_pu"] for e in changes],
        "events": events,
    }
    if not one_clock and scenario.mode == "realtime":
        summary["clock_drift_ppm"] = clock_drift(timing, scenario.T_s)
    return summary


def misses(timing: Mapping[str, Rows], done: int) -> int:
    """Ticks whose u had not arrived by the next deadline; 0 in lockstep, which has none."""
    if "plant_scheduled" not in timing:
        return 0
    if not any((x >= 0).any() for x in blocks(timing["plant_scheduled"], 0, done)):
        return 0
    return sum(int(np.sum(x < 0)) for x in blocks(timing["plant_received"], 0, done))


def clock_drift(timing: Mapping[str, Rows], T_s: float) -> float | None:
    """How fast the plant's clock runs against the controller's, ppm; None if that is unknown.

    The slope of the earliest arrivals: what is late was late on the way, the earliest was not.
    """
    received = timing.get("controller_received")
    if received is None:
        return None
    count, origin, first = 0, None, []
    bounds = np.linspace(0, len(received), _BLOCKS + 1).astype(int).tolist()
    for a, b in pairwise(bounds):
        x = received[a:b]
        k = np.flatnonzero(x >= 0)
        if len(k):
            origin = int(x[k[0]]) if origin is None else origin
            away = x[k] - origin - np.round((a + k) * (T_s * 1e9)).astype(np.int64)
            least = int(np.argmin(away))
            first.append(((a + int(k[least])) * T_s, float(away[least]) * 1e-3))
            count += len(k)
    if count < 2 * _BLOCKS or len(first) < 2:
        return None
    times, away_us = np.transpose(first)
    slope = np.polyfit(times, away_us, 1)[0]  # us a second: ppm
    return round(-float(slope), 3)


@dataclass(frozen=True)
class Spread:
    """How many ticks took how long: ``ns`` are the different durations in order, ``count`` how
    many ticks took each. It takes little memory, as ticks by far outnumber durations."""

    ns: NDArray[np.int64]
    count: NDArray[np.int64]

    @staticmethod
    def between(timing: Mapping[str, Rows], begin: str, end: str) -> Spread:
        """From one column of ``timing`` to another, over the ticks in which ``end`` happened."""
        total: dict[str, NDArray[np.int64]] = {"ns": np.empty(0, np.int64)}
        total["count"] = total["ns"]
        column = timing[end]
        whole = len(column)
        for a, b in zip(blocks(timing[begin], 0, whole), blocks(column, 0, whole), strict=True):
            new, many = np.unique((b - a)[b >= 0], return_counts=True)
            ns, at = np.unique(np.concatenate([total["ns"], new]), return_inverse=True)
            count = np.zeros(len(ns), np.int64)
            np.add.at(count, at, np.concatenate([total["count"], many]))
            total = {"ns": ns, "count": count}
        return Spread(**total)

    def percentile(self, q: float) -> float:
        """The percentile of all durations as ``np.percentile`` has it, ns."""
        behind = np.cumsum(self.count)
        at = q / 100 * (behind[-1] - 1)
        low, high = self.ns[np.searchsorted(behind, [np.floor(at), np.ceil(at)], side="right")]
        return float(low + (high - low) * (at - np.floor(at)))


def round_trip(timing: Mapping[str, Rows]) -> dict[str, float] | None:
    """Percentiles of the time from y[k] sent to u[k] received at the plant, µs."""
    if "plant_received" not in timing:
        return None
    spread = Spread.between(timing, "plant_sent", "plant_received")
    if not len(spread.ns):
        return None
    marks = {"p50": 50, "p99": 99, "p99.9": 99.9, "max": 100}
    return {name: round(spread.percentile(q) / 1e3, 2) for name, q in marks.items()}
