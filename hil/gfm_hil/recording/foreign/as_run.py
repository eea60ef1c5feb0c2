"""A recording as a run: checked, aligned to the first event of what was run, and resampled."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.core.schema import read_model
from gfm_hil.recording.foreign.channels import RecordingMap
from gfm_hil.recording.foreign.files import read_channels
from gfm_hil.recording.foreign.signals import SampledRecording, Vector, at_ticks, sampled, sequences
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.grid_frequency import GridFrequency

ABOUT = "recording"  #: the entry of a summary that tells how a recording was read
_BAND, _BAND_S = 1e-3, 0.1  # p.u. and s: the least band of rest, and how long it is looked at
_SPREADS = 3.0  # the band is so many times as wide as the signal moves at rest
_NEAR_P, _NEAR_V, _NEAR_F = 0.1, 0.15, 0.02  # p.u. from where the test begins
_OFF, _LOADED = 0.01, 0.05  # p.u. of current: of a converter that is off, and of one that is not
#: kinds of events that leave the frequency of a stiff grid as it is
_KEEP = (
    "grid-phase-jump", "grid-voltage", "grid-impedance", "fault", "fault-clear", "grid-unbalance",
    "reference",
)  # fmt: skip


class _Columns(dict[str, Any]):
    """Columns; of one that the recording cannot have a UserError says so."""

    def __missing__(self, name: str) -> Any:
        raise UserError(f"the recording has no {name.removeprefix('true_')}")


def open_recording(file: str | Path, map_file: str | Path, scenario: Scenario) -> Run:
    """A recording of what a scenario asks, as a run of it.

    p, q, V, i are those of the recording; the frequency of the converter is that of the voltage,
    and its current that of the line. The grid's frequency is recorded, or what the scenario
    prescribes. Before the recording begins all are nan. Raises UserError: a file cannot be read, a
    channel is missing, or the recording does not begin where the scenario does: base, unit, sign,
    order of phases or time are wrong.

    Args:
        file: CSV, COMTRADE (its .cfg or .cff), Parquet, MF4 or MAT.
        map_file: what its channels are, see ``RecordingMap``.
        scenario: what was done; its first event is where the recording is aligned.
    """
    file, of = Path(file), read_model(map_file, RecordingMap)
    f_n, T_s = nominal_frequency(scenario), scenario.T_s
    try:
        s = sampled(read_channels(file), of, f_n)
        event, told = _event(s, of, scenario, 1 / f_n)
        _check_rest(s, event, scenario, f_n)
    except UserError as problem:
        words = str(problem)
        raise UserError(words if words.startswith(f"{file}:") else f"{file}: {words}") from None
    first = min(e.at(T_s) for e in scenario.events) * T_s
    resolution = max(s.dt, of.meter.window_s, of.meter.lag_s)
    # what is cut off at the end by less than a mean's width is held
    last = s.t[-1] - event + first + 2 * max(1 / f_n, resolution)
    ticks = min(scenario.ticks, math.floor(last / T_s))
    t = T_s * np.arange(ticks, dtype=np.float64)
    there = np.minimum(t - first + event, s.t[-1])
    columns = _Columns(tick=np.arange(ticks), t=t)
    names = {"f": "omega_u", "f_grid": "omega_g"}
    for name, x in s.of.items():
        if name != "trip":
            columns[f"true_{names.get(name, name)}"] = at_ticks(s, x, there, T_s)
    frame = np.exp(-2j * math.pi * f_n * (s.t - event))
    for name, vector in s.vectors.items():
        rests = at_ticks(s, vector * frame, there, T_s)
        columns |= {f"true_{name}_re": rests.real, f"true_{name}_im": rests.imag}
    if (
        "true_omega_g" not in columns
        and (omega_g := _prescribed_frequency(scenario, t, f_n)) is not None
    ):
        columns["true_omega_g"] = omega_g
    if not any(e.type == "reference" for e in scenario.events):
        columns["ref_P_ref"] = np.full(ticks, scenario.references.P_ref)
    status, reason, end = _ends(s, event, 1 / f_n)
    keep = ticks if end is None else min(ticks, max(0, round((end - event + first) / T_s)))
    columns = _Columns({name: x[:keep] for name, x in columns.items()})
    way = "phases" if s.vectors else "channels" if of.v is None else "phasors"
    rate = f"{1 / s.dt:.6g} samples/s"
    about = {
        "event_s": event, "resolution_s": resolution, "dt_s": s.dt, **of.meter.model_dump(),
        "trips_seen": reason != "?",
        "words": f"{way} at {rate}; event at {event:.6g} s of its clock, {told}, laid on "
        f"{first:g} s of the test; what is slower than {1e3 * resolution:.3g} ms is seen",
    }  # fmt: skip
    events = [{"t": e.at(T_s) * T_s, "tick": e.at(T_s), "type": e.type, "label": e.label()}
              for e in scenario.sorted_events() if e.at(T_s) < keep]  # fmt: skip
    summary = {
        "status": status, "reason": "" if reason == "?" else reason, "unmet": [], "ticks": keep,
        "duration_s": round(keep * T_s, 9), "events": events, "controller": file.stem, "laws": [],
        ABOUT: about,
    }  # fmt: skip
    return Run(scenario, summary, columns)


def _event(
    s: SampledRecording, of: RecordingMap, scenario: Scenario, cycle: float
) -> tuple[float, str]:
    """When the first event is by the recording's clock, s, and how that is known: where p, q or V
    leaves the band in which it rests. Raises UserError: nothing moves, or not where the map says
    that the event is."""
    if not scenario.events:
        raise UserError("the scenario has no event to align it to")
    from scipy.ndimage import uniform_filter1d  # a tenth of a second, of recordings only

    # what the map says to lie before the event shows most of how the signals move at rest
    rest_s = _BAND_S if of.event_s is None else max(_BAND_S, of.event_s - cycle - float(s.t[0]))
    found: list[tuple[int, str]] = []
    for width in (1, int(cycle / s.dt)):  # samples, or means of a cycle where noise hides all
        for name in ("p", "q", "V") if width and not found else ():
            x = uniform_filter1d(s.of[name], width, mode="nearest")
            first = x[: max(5, int(rest_s / s.dt))]
            middle = np.median(first)
            band = max(_BAND, _SPREADS * float(np.max(np.abs(first - middle))))
            if (moved := np.abs(x - middle) > band).any():
                found.append((int(np.argmax(moved)), name))
    if not found:
        where = "" if of.event_s is None else f"event_s = {of.event_s:g} of its map: "
        raise UserError(
            f"{where}no event: p, q and V stay as in the first {rest_s:g} s, which must be at rest"
        )
    k, name = min(found)
    at = float(s.t[max(0, k - 1)])  # the last sample of before
    words = f"found: {name} leaves its band of rest"
    if of.event_s is None:
        return at, words
    if not -0.1 - s.dt < of.event_s - at < cycle + s.dt:
        raise UserError(
            f"event_s = {of.event_s:g} of its map: {name} leaves its band of rest at {at:.6g} s; "
            "the clock or the map is shifted"
        )
    return of.event_s, f"as its map says ({name} leaves its band of rest at {at:.6g} s)"


def _check_rest(s: SampledRecording, event: float, scenario: Scenario, f_n: float) -> None:
    """See that the recording rests where the scenario begins. Raises UserError: it does not."""
    before = s.t <= event + 1e-12
    before[: max(0, int(before.sum()) - max(2, int(10 / f_n / s.dt)))] = False
    span = float(np.ptp(s.t[before])) + s.dt if before.any() else 0.0
    if span < 1.01 / f_n and before.sum() < 3:
        raise UserError(f"it has {span:.3g} s before the event: must have a cycle at least")
    for name, x in s.vectors.items():
        ahead, back = sequences(s.t[before], x[before], f_n)
        if back > ahead:
            raise UserError(
                f"{name}: its phases follow the other way round ({back:.3g} p.u. of the negative "
                f"sequence, {ahead:.3g} of the positive one): two of them are swapped"
            )
        if back > 0.3 * ahead and ahead > _LOADED:
            raise UserError(
                f"{name}: a phase is missing, swapped or reversed: the negative sequence has "
                f"{back:.3g} p.u. before the event, the positive one {ahead:.3g}"
            )
    wanted = {"V": (1.0, _NEAR_V, "V_n, unit or scale"),
              "f": (1.0, _NEAR_F, f"its unit; 1 p.u. of this test is {f_n:g} Hz"),
              "p": (scenario.references.P_ref, _NEAR_P,
                    "S_n, unit, scale, sign, or the order of the phases of i")}  # fmt: skip
    for name, (want, near, which) in wanted.items():
        if name in s.of and not abs((have := float(np.mean(s.of[name][before]))) - want) <= near:
            raise UserError(
                f"{name} = {have:.4g} p.u. before the event, where the test begins at {want:g}: "
                f"see {which}"
            )


def _ends(s: SampledRecording, event: float, cycle: float) -> tuple[str, str, float | None]:
    """Status, reason and time of the end of a converter that trips: by the channel of its trip, or
    as it carries no current to the end. "?" is the reason if the recording cannot show it."""
    if "trip" in s.of:
        on = s.of["trip"] != 0
        return (
            ("tripped", "trip", float(s.t[np.argmax(on)])) if on.any() else ("completed", "", None)
        )
    size = np.hypot(s.of["p"], s.of["q"])
    if np.max(size[s.t <= event]) < _LOADED:
        return "completed", "?", None
    off = int(np.flatnonzero(size > _OFF)[-1]) + 1
    if off < len(size) and s.t[-1] - s.t[off] > 2 * cycle:
        return "tripped", "no current", float(s.t[off])
    return "completed", "", None


def _prescribed_frequency(scenario: Scenario, t: Vector, f_n: float) -> Vector | None:
    """The frequency of a stiff grid as a scenario prescribes it, p.u.; None if it does not."""
    moves = [e for e in scenario.sorted_events() if e.type not in _KEEP]
    stiff = scenario.network is None and scenario.plant.grid.finite is None
    if not stiff or not all(isinstance(e, GridFrequency) for e in moves):
        return None
    found = np.ones_like(t)
    for e in moves:
        assert isinstance(e, GridFrequency)
        k = min(e.at(scenario.T_s), len(t) - 1)
        begin, to = float(found[k]), e.f_hz / f_n
        way = math.inf if e.rate is None else e.rate / f_n
        with np.errstate(invalid="ignore"):
            done = np.minimum(way * (t[k:] - t[k]), abs(to - begin)) if e.rate else abs(to - begin)
        found[k:] = begin + math.copysign(1.0, to - begin) * done
    return found
