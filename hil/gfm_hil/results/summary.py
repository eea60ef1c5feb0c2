"""summary.json: how a run ended and what it showed."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from gfm_hil.recording.columns import Columns
from gfm_hil.recording.log import Outcome
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.recording.timing import ROUND_TRIP, count_misses
from gfm_hil.results.metrics import event_metrics
from gfm_hil.scenario.expectation import unmet
from gfm_hil.scenario.model import Scenario

_BLOCKS = 20  # of a run, whose earliest arrivals tell the drift of its clocks


def summarise(
    scenario: Scenario,
    signals: Columns,
    timing: Columns,
    log: list[dict[str, Any]],
    outcome: Outcome,
    links: Mapping[str, dict[str, Any]],
    wall_s: float,
) -> dict[str, Any]:
    """The summary of one run as plain data.

    Args:
        scenario: of the run.
        signals, timing: the columns of the files of these names, read piece by piece.
        log: lines of events.jsonl.
        outcome: how the run ended.
        links: what each side wrote about its end of the link (``link_<side>.json``), by side;
            empty for a run in one process.
        wall_s: how long it took, s.
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
        "misses": count_misses(timing, done),
        "round_trip_us": _round_trip(timing, scenario.T_s),
        "faults": {
            side: {k: n for k, n in end["faults"].items() if n} for side, end in links.items()
        },
        "e2e": {side: end["e2e"] for side, end in links.items()},
        "bump_pu": [e["bump_pu"] for e in changes],
        "events": events,
    }
    injected = {side: end["injected"] for side, end in links.items() if "injected" in end}
    if injected:
        summary["injected"] = injected
    one_clock = all(end["one_clock"] for end in links.values())
    if not one_clock and scenario.mode == "realtime":
        summary["clock_drift_ppm"] = clock_drift(timing, scenario.T_s)
    return summary


def _round_trip(timing: Columns, T_s: float) -> dict[str, float] | None:
    """Percentiles, µs; None where no u was received."""
    if not timing.keys() >= {*ROUND_TRIP.needs}:
        return None
    return ROUND_TRIP.spread(timing, T_s).percentiles_us() or None


def clock_drift(timing: Columns, T_s: float) -> float | None:
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
