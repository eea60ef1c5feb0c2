"""summary.json: how a run ended and what it showed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.expectation import unmet
from gfm_hil.metrics import event_metrics
from gfm_hil.scenario import Scenario
from gfm_hil.timeline import Outcome
from gfm_plant import load_converter

_BLOCKS = 20  # of a run, whose earliest arrivals tell the drift of its clocks


def nominal_frequency(scenario: Scenario) -> float:
    """Nominal frequency of the scenario's converter, Hz."""
    return load_converter(scenario.plant.converter).bases.omega_b / (2 * np.pi)


def summarise(
    scenario: Scenario,
    signals: dict[str, NDArray[Any]],
    timing: dict[str, NDArray[Any]],
    log: list[dict[str, Any]],
    outcome: Outcome,
    faults: dict[str, dict[str, int]],
    wall_s: float,
    one_clock: bool = True,
) -> dict[str, Any]:
    """The summary of one run as plain data."""
    done = len(signals["tick"])
    changes = [e for e in log if e["event"] == "law-active"]
    happened = [e for e in log if "label" in e]
    bumps = {e["tick"]: e["bump_pu"] for e in changes}
    starts = [*[e["tick"] for e in happened], done]
    f_n = nominal_frequency(scenario)
    events = []
    for k, e in enumerate(happened):
        stop = min((t for t in starts[k + 1 :] if t > e["tick"]), default=done)
        entry = {"t": e["t"], "tick": e["tick"], "type": e["event"], "label": e["label"]}
        if e["event"] == "law":
            entry["bump_pu"] = bumps.get(e["tick"])
        if "true_p" in signals:
            entry.update(event_metrics(signals, e["tick"], stop, scenario.T_s, f_n))
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


def misses(timing: dict[str, NDArray[Any]], done: int) -> int:
    """Ticks whose u had not arrived by the next deadline; 0 in lockstep, which has none."""
    if "plant_scheduled" not in timing or (timing["plant_scheduled"] < 0).all():
        return 0
    return int(np.sum(timing["plant_received"][:done] < 0))


def clock_drift(timing: dict[str, NDArray[Any]], T_s: float) -> float | None:
    """How fast the plant's clock runs against the controller's, ppm; None if that is unknown.

    The slope of the earliest arrivals: what is late was late on the way, the earliest was not.
    """
    received = timing.get("controller_received")
    if received is None or (received >= 0).sum() < 2 * _BLOCKS:
        return None
    k = np.flatnonzero(received >= 0)
    away = received[k] - received[k[0]] - np.round((k - k[0]) * (T_s * 1e9)).astype(np.int64)
    first = [block[np.argmin(away[block])] for block in np.array_split(np.arange(len(k)), _BLOCKS)]
    slope = np.polyfit((k[first] - k[0]) * T_s, away[first] * 1e-3, 1)[0]  # us a second: ppm
    return round(-float(slope), 3)


def round_trip(timing: dict[str, NDArray[Any]]) -> dict[str, float] | None:
    """Percentiles of the time from y[k] sent to u[k] received at the plant, µs."""
    if "plant_received" not in timing:
        return None
    there = timing["plant_received"] >= 0
    if not there.any():
        return None
    us = (timing["plant_received"][there] - timing["plant_sent"][there]) / 1e3
    marks = {"p50": 50, "p99": 99, "p99.9": 99.9, "max": 100}
    return {name: round(float(np.percentile(us, q)), 2) for name, q in marks.items()}
