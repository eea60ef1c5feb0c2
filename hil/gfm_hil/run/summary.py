"""summary.json: how a run ended and what it showed."""

import math
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from itertools import pairwise
from typing import Any

import numpy as np

from gfm_hil.core.roles import OUR_CONTROLLER, Role, target_of
from gfm_hil.recording.columns import INSTRUCTIONS, ColumnLike, Columns, pieces
from gfm_hil.recording.log import Outcome, cause, unmet, was_stopped
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.recording.timing import ROUND_TRIP, DurationHistogram, count_misses
from gfm_hil.run.doctor import verdict
from gfm_hil.run.metrics import event_metrics
from gfm_hil.run.modes import acting, free_from
from gfm_hil.run.ripple import remaining_ripple
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.note import NOTE
from gfm_hil.scenario.expectation import reason_name
from gfm_runtime import law_titles, load_law
from gfm_runtime.inner_file import NO_INNER

_BLOCKS = 20  # of a run, whose earliest arrivals tell the drift of its clocks
_FAULTS = ("tripped", "safe")
#: metrics of where a response ends, which a response that a trip cuts short does not have
END_METRICS = ("p_final", "settling_s", "overshoot_pct")
#: the recorded columns that the summary of a run in memory reads
READ = frozenset(
    {
        *("true_p", "true_omega_u", "true_V", "true_i", "true_delta", "true_omega_g", "true_V_g"),
        "law",
    }
)
_STEPS = ("reference", "grid-frequency", "grid-voltage")  # events that may move p to a new value


@cache
def _version() -> str:
    """Of this program; the look-up reads files, which a campaign would do for each of its runs."""
    return version("gfmhil")


def origin(scenario: Scenario, began: float) -> dict[str, Any]:
    """Where a recording comes from: date (UTC), version, this machine and the doctor's verdict.

    Args:
        scenario: in lockstep nothing depends on the machine, so there is no verdict.
        began: when the run began, s since 1970.
    """
    judged = verdict() if scenario.mode == "realtime" else None
    return {
        "date": datetime.fromtimestamp(began, UTC).isoformat(timespec="seconds"),
        "version": _version(),
        "machines": {platform.node(): judged},
    }


def stages(scenario: Scenario) -> dict[str, Any]:
    """The kind of the inner stage of each law, under the key ``inner``; empty if no law of the run
    has one."""
    if not scenario.signal_set:
        return {}
    laws = {
        title: load_law(name, scenario.inner, scenario.counts).first
        for name, title in law_titles(scenario.laws()).items()
    }
    kinds = {name: law.inner.kind if law.inner else NO_INNER for name, law in laws.items()}
    return {"inner": kinds}


def summarise(
    scenario: Scenario,
    signals: Columns,
    timing: Columns,
    log: list[dict[str, Any]],
    outcome: Outcome,
    links: Mapping[Role, dict[str, Any]],
    wall_s: float,
) -> dict[str, Any]:
    """The summary of one run as plain data; None where the recording does not say.

    Args:
        scenario, outcome, log: of the run.
        signals, timing: the columns of the files of these names, read piece by piece. A side that
            recorded nothing has no columns.
        links: what each side wrote about its end of the link (``link_<role>.json``), by role;
            empty for a run in one process.
        wall_s: how long the run took, s.
    """
    done = len(signals["tick"])
    notes = [{"t": e["t"], "text": e["label"]} for e in log if e["event"] == NOTE]
    log = [e for e in log if e["event"] != NOTE]
    met = [e for e in log if e["event"] == "handshake"]
    controller: str | None = met[0]["controller"] if met else OUR_CONTROLLER
    plant, ours = "true_p" in signals, "law" in signals
    ripple = None
    if plant and outcome.status == "completed":
        ripple = remaining_ripple(scenario, signals, log, done)
        if ripple is not None and ripple.oscillates:
            outcome = Outcome("oscillating", ripple.words(), outcome.tick)
    trips = _trips(log, outcome, done, scenario.T_s)
    if plant and not outcome.reason and not trips:
        outcome = Outcome(outcome.status, _out_of_step(scenario, signals, log, done), outcome.tick)
    changes = [e for e in log if e["event"] == "law-active"]
    first = law_titles(scenario.laws())[scenario.law]
    laws = [first, *[e["law"] for e in changes]]
    summary = {
        "title": scenario.title,
        "status": outcome.status,
        "reason": reason_of(outcome, trips),
        "stopped": was_stopped(log),
        "expected": scenario.expect,
        "unmet": unmet(scenario, outcome, log, done),
        "controller": controller,
        "laws": laws if target_of(controller) is not None else [],
        "link": scenario.link.type,
        "mode": scenario.mode,
        "T_s": scenario.T_s,
        "ticks": done,
        "duration_s": done * scenario.T_s,
        "wall_s": wall_s,
        "misses": count_misses(timing, done) if plant else None,
        "round_trip_us": _round_trip(timing, scenario.T_s),
        "faults": {
            role: {k: n for k, n in end["faults"].items() if n} for role, end in links.items()
        },
        "e2e": {role: end["e2e"] for role, end in links.items()},
        "bump_pu": [e["bump_pu"] for e in changes] if ours else None,
        "ripple_pu": ripple.pu if ripple else None,
        "trips": [{k: v for k, v in trip.items() if k != "until"} for trip in trips],
        "events": _events(scenario, signals if plant else None, log, trips, done),
        "run": met[0]["run"] if met else None,
    }
    if notes:
        summary["notes"] = notes
    if INSTRUCTIONS in timing:
        summary["instructions"] = _instructions(timing[INSTRUCTIONS])
    injected = {role: end["injected"] for role, end in links.items() if "injected" in end}
    if injected:
        summary["injected"] = injected
    if scenario.mode == "realtime" and not all(e["one_clock"] for e in met):
        summary["clock_drift_ppm"] = clock_drift(timing, scenario.T_s)
    return summary


def _out_of_step(
    scenario: Scenario, signals: Columns, log: Sequence[dict[str, Any]], done: int
) -> str:
    """Words on an angle to the grid that ends half a turn or more from where it began; empty
    without one. In a network, or behind a breaker, the angle to the grid may be anyone's."""
    delta = signals["true_delta"]
    if scenario.network is not None or any(e["event"] == "grid-breaker" for e in log) or not done:
        return ""
    first, last = float(delta[:1][0]), float(delta[done - 1 : done][0])
    if not abs(last - first) >= math.pi:
        return ""
    at, tick = 0, done - 1
    for piece in pieces(delta, 0, done):
        beyond = np.flatnonzero(np.abs(piece - first) >= math.pi)
        if len(beyond):
            tick = at + int(beyond[0])
            break
        at += len(piece)
    t, degrees = tick * scenario.T_s, math.degrees(last - first)
    return f"fell out of step at {t:.4g} s: its angle to the grid ends {degrees:+.4g}° from before"


def _events(
    scenario: Scenario,
    signals: Columns | None,
    log: Sequence[dict[str, Any]],
    trips: Sequence[dict[str, Any]],
    done: int,
) -> list[dict[str, Any]]:
    """What happened, with the metrics of what followed; without them if ``signals`` is None."""
    happened = [e for e in log if "label" in e]
    bumps = {e["tick"]: e["bump_pu"] for e in log if e["event"] == "law-active"}
    starts = np.array([e["tick"] for e in happened])  # in order, as the log is
    ends = np.searchsorted(starts, starts, side="right").tolist()
    T_s, f_n = scenario.T_s, nominal_frequency(scenario)
    acts = acting(scenario, signals, done) if signals is not None else []
    events = []
    for e, end in zip(happened, ends, strict=True):
        entry = {"t": e["t"], "tick": e["tick"], "type": e["event"], "label": e["label"]}
        if e["event"] == "law":
            entry["bump_pu"] = bumps.get(e["tick"])
        if signals is not None:
            stop = min(int(starts[end]) if end < len(starts) else done, done)
            trip = next((x for x in trips if x["until"] > e["tick"]), None)
            if trip is not None and (trip["tick"] < stop or stop == done):
                stop = min(stop, trip["tick"])
                entry["cut_short"] = f"{reason_name(trip['reason'])} at {trip['t']:g} s"
            free = free_from(acts, e["tick"], stop)
            entry.update(event_metrics(signals, e["tick"], stop, T_s, f_n, free))
            if "cut_short" in entry:
                entry.update(dict.fromkeys(END_METRICS))
            if e["event"] not in _STEPS:
                entry["overshoot_pct"] = None
        events.append(entry)
    return events


def _round_trip(timing: Columns, T_s: float) -> dict[str, float] | None:
    """Percentiles, µs; None where no u was received."""
    if not timing.keys() >= {*ROUND_TRIP.needs}:
        return None
    return ROUND_TRIP.histogram(timing, T_s).percentiles_us() or None


def _instructions(counted: ColumnLike) -> dict[str, int]:
    """The fewest, the median and the most of a tick, of the ticks in which they were counted."""
    found = DurationHistogram.of(piece[piece >= 0] for piece in pieces(counted, 0, len(counted)))
    return {
        name: round(found.percentile(q)) for name, q in (("least", 0), ("p50", 50), ("most", 100))
    }


def reason_of(outcome: Outcome, trips: Sequence[Mapping[str, Any]]) -> str:
    """The reason for a run's end; after the operator ended it, also for a trip in force by then."""
    if outcome.status != "interrupted" or not trips or trips[-1]["until"] < math.inf:
        return outcome.reason
    return f"{outcome.reason}; since {trips[-1]['t']:g} s: {trips[-1]['reason']}"


def _trips(
    log: list[dict[str, Any]], outcome: Outcome, done: int, T_s: float
) -> list[dict[str, Any]]:
    """Every trip and safe state of a run: tick, t in s, reason, and the tick ``until`` which it
    lasted. Tick and reason are those of the side to which it happened."""
    found: list[dict[str, Any]] = []
    open_roles: set[str] = set()
    for e in log:
        begins = e["event"] in _FAULTS or (e["event"] == "end" and e["status"] in _FAULTS)
        if begins and open_roles:
            if cause([found[-1]["reason"], e["reason"]]) != found[-1]["reason"]:
                found[-1] |= {"tick": e["tick"], "reason": e["reason"]}
        elif begins:
            found.append({"tick": e["tick"], "reason": e["reason"], "until": math.inf})
        if begins:
            open_roles.add(e.get("role", ""))
        elif e["event"] == "recovered":
            open_roles.discard(e.get("role", ""))
            if not open_roles:
                found[-1]["until"] = e["tick"]
    if outcome.status in _FAULTS:
        if not open_roles:  # no side lived to write it down
            found.append({"tick": done, "until": math.inf})
        found[-1]["reason"] = outcome.reason
    for trip in found:
        trip["tick"] = min(trip["tick"], done)
        trip["t"] = round(trip["tick"] * T_s, 9)
    return found


def clock_drift(timing: Columns, T_s: float) -> float | None:
    """How fast the plant's clock runs against the controller's, ppm; None if that is unknown.

    The slope of the earliest arrivals, which the link did not delay.
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
