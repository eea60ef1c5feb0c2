"""What a finished run says to the criteria of a test: nothing runs here, and nothing is written.

Powers, voltages, currents and frequencies are judged by their means over one cycle of the nominal
frequency (``run.cycles``); only how fast p rises, and the angle, are of every tick.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import unit_of
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.run import checks
from gfm_hil.run.cycles import cycle_means, cycle_ticks, whole_ticks
from gfm_hil.run.modes import acting, free_from, swing
from gfm_hil.run.ripple import remaining_ripple
from gfm_hil.scenario.events import GridFrequency, GridImpedance, PhaseJump
from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.conformity.model import (
    Criterion,
    Damped,
    Energy,
    InEnvelope,
    InStep,
    Nfp,
    NoOscillation,
    NoTrip,
    PeakDelta,
    Rise,
    Settles,
    StaysWithin,
    UnderTest,
)
from gfm_hil.studies.envelopes import Envelope, Unit, phase_jump, rocof, scr_jump

Outcome = Literal["pass", "fail", "cannot judge", "informative"]
PASS: Final = "pass"
FAIL: Final = "fail"
CANNOT: Final = "cannot judge"
INFORMATIVE: Final = "informative"  # no law can be judged by it: it counts for nothing
SIGNS = {PASS: "✓", FAIL: "✗", CANNOT: "?", INFORMATIVE: "i"}

_LASTED = ("completed", "oscillating")
_CURVE = 600  # points of a limit in the figure
_NO_RISE = 0.02  # p.u.; of a smaller peak no rise time is told

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Verdict:
    """What became of one clause at one time.

    Attributes:
        clause: what is asked.
        kind: of the criterion.
        signal: that was judged; may be empty.
        start, stop: of the window, s.
        verdict: pass, fail, cannot judge or informative.
        value: measured, in ``unit``; None if there is none.
        unit: of the value.
        limit: of the value, with its unit.
        text: one sentence.
        low, high: limits of the signal itself between ``limited`` s, for the figure.
        limited: from when to when they hold, s.
        curve: t, s, and limits that change with it, shape (K,) each, for the figure.
    """

    clause: str
    kind: str
    signal: str
    start: float
    stop: float
    verdict: Outcome
    value: float | None
    unit: str
    limit: str
    text: str
    low: float | None = None
    high: float | None = None
    limited: tuple[float, float] | None = None
    curve: tuple[Vector, Vector, Vector] | None = None

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {name: x for name, x in asdict(replace(self, curve=None)).items() if name != "curve"}


def judge(
    run: Run,
    criteria: Sequence[Criterion],
    under: UnderTest,
    others: Mapping[str, Run] | None = None,
) -> list[Verdict]:
    """The verdicts of all criteria, each at each of its times.

    Args:
        run: of the converter under test; it may have ended early.
        criteria: of the test and of its part.
        under: what the owner of the converter declares.
        others: the runs of the other converters of a network, which must not trip either.
    """
    return [
        _Judge(run, under, others or {}, criterion, at).verdict()
        for criterion in criteria
        for at in criterion.at or [_first(run)]
    ]


def judge_nfp(hz: Vector, nfp: NDArray[np.complex128], asked: Nfp) -> list[Verdict]:
    """The verdicts on a network-frequency-perturbation plot, one a band.

    Args:
        hz: frequencies, Hz, shape (K,).
        nfp: change of p over that of the grid's frequency, p.u. over p.u., shape (K,).
        asked: its bands, or why there are none.
    """
    made = partial(Verdict, asked.clause, asked.kind, "p", 0.0, 0.0)
    gain, phase = np.abs(nfp), np.degrees(np.angle(nfp))
    span = f"From {hz[0]:.3g} to {hz[-1]:.3g} Hz the gain lies between {gain.min():.4g} and "
    span += f"{gain.max():.4g} p.u./p.u."
    if asked.unknown is not None:
        text = f"Informative: {asked.unknown}. {span}"
        return [made(INFORMATIVE, float(gain.max()), "p.u./p.u.", "", text)]
    found = []
    for band in asked.bands:
        inside = (hz >= band.from_hz) & (hz <= band.to_hz)
        where = f"{band.from_hz:g} to {band.to_hz:g} Hz"
        if not inside.any():
            found.append(made(CANNOT, None, "", where, f"No point lies between {where}."))
            continue
        for x, low, high, unit, name in (
            (gain, band.low, band.high, "p.u./p.u.", "gain"),
            (phase, band.phase_low, band.phase_high, "°", "phase"),
        ):
            if low is None and high is None:
                continue
            beyond = np.maximum(
                -math.inf if low is None else low - x, -math.inf if high is None else x - high
            )
            k = int(np.argmax(np.where(inside, beyond, -math.inf)))
            ok = bool(beyond[k] <= 0)
            limits = [f"at least {low:g} {unit}"] if low is not None else []
            limits += [f"at most {high:g} {unit}"] if high is not None else []
            text = (
                f"At {hz[k]:.3g} Hz the {name} is {x[k]:.4g} {unit}, the nearest to its limits "
                f"or the furthest beyond them between {where}."
            )
            limit = f"{' and '.join(limits)}, {where}"
            found.append(made(PASS if ok else FAIL, float(x[k]), unit, limit, text))
    return found


def cannot(criteria: Sequence[Criterion], reason: str) -> list[Verdict]:
    """Verdicts on a run that did not take place, or none of a part without criteria."""
    return [
        Verdict(c.clause, c.kind, getattr(c, "signal", ""), at, at, CANNOT, None, "", "", reason)
        for c in criteria
        for at in c.at or [0.0]
    ]


def worst(outcomes: Sequence[str]) -> Outcome:
    """fail before cannot judge before pass before informative; no outcome at all cannot be
    judged."""
    order: tuple[Outcome, ...] = (FAIL, CANNOT, PASS, INFORMATIVE)
    return next((outcome for outcome in order if outcome in outcomes), CANNOT)


def _first(run: Run) -> float:
    """When the first event happens, s; 0 without any."""
    T_s = run.scenario.T_s
    return min((e.at(T_s) * T_s for e in run.scenario.events), default=0.0)


class _Judge:
    """One criterion at one time ``at`` [s]."""

    def __init__(
        self,
        run: Run,
        under: UnderTest,
        others: Mapping[str, Run],
        criterion: Criterion,
        at: float,
    ) -> None:
        self.run, self.under, self.others, self.c = run, under, others, criterion
        self.T_s = run.scenario.T_s
        self.f_n = nominal_frequency(run.scenario)
        self.width = cycle_ticks(self.T_s, self.f_n)
        self.at, self.tick = at, round(at / self.T_s)
        whole = run.scenario.ticks
        later = [e.at(self.T_s) for e in run.scenario.events if e.at(self.T_s) > self.tick]
        self.first, self.last = self.tick, min(later, default=whole)
        if (window := getattr(criterion, "window", None)) is not None:
            self.first, self.last = (self.tick + round(x / self.T_s) for x in window)
        if isinstance(criterion, NoTrip | NoOscillation):
            self.tick = self.first = 0
            self.last = whole

    def verdict(self) -> Verdict:
        """The verdict; a window that the run did not reach cannot be judged."""
        kinds: dict[type, Callable[[Any], Verdict]] = {
            StaysWithin: self._stays_within,
            Settles: self._settles,
            PeakDelta: self._peak,
            Rise: self._rise,
            Damped: self._damped,
            Energy: self._energy,
            NoTrip: self._no_trip,
            NoOscillation: self._no_oscillation,
            InStep: self._in_step,
            InEnvelope: self._in_envelope,
        }
        c = self.c
        if not isinstance(c, NoTrip):
            if self.run.ticks < self.last:
                return self._cannot(f"{self._end()}, before the end of the window")
            if self.last - self.first < 2 * whole_ticks(self.width):
                return self._cannot("the window is shorter than two cycles")
            if not isinstance(c, NoOscillation) and self.tick < whole_ticks(self.width):
                return self._cannot("no whole cycle was recorded before the event")
        return kinds[type(c)](c)

    def _made(
        self,
        ok: bool,
        value: float | None,
        unit: str,
        limit: str,
        text: str,
        signal: str = "",
        low: float | None = None,
        high: float | None = None,
        limited: tuple[float, float] | None = None,
    ) -> Verdict:
        start, stop = self.first * self.T_s, self.last * self.T_s
        return Verdict(
            self.c.clause, self.c.kind, signal, round(start, 9), round(stop, 9),
            PASS if ok else FAIL, value, unit, limit, f"{text.rstrip('.')}.", low, high, limited,
        )  # fmt: skip

    def _cannot(self, reason: str) -> Verdict:
        why = self.c.informative
        verdict: Outcome = CANNOT if why is None else INFORMATIVE
        text = f"Cannot be judged: {reason}" + (f" (informative: {why})." if why else ".")
        made = self._made(True, None, "", "", text)
        return replace(made, verdict=verdict, signal=getattr(self.c, "signal", ""))

    def _end(self) -> str:
        """How the run ended early."""
        summary = self.run.summary
        return (
            f"the run ended at {self.run.ticks * self.T_s:.4g} s ({summary['status']}: "
            f"{reason_name(summary['reason'])})"
        )

    # signals

    def _raw(self, name: str) -> Vector:
        return np.asarray(self.run.signals[name], np.float64)

    def _means(self, name: str, first: int, last: int) -> Vector:
        parts = cycle_means(self._raw(name), first, last, self.width)
        return np.concatenate([np.empty(0), *parts])

    def _before(self, name: str) -> float:
        """The mean of the last cycle before the event."""
        return float(self._means(name, self.tick - whole_ticks(self.width), self.tick)[0])

    def _ending(self, name: str) -> float:
        """The mean of the last cycle of the window."""
        return float(self._means(name, self.last - whole_ticks(self.width), self.last)[0])

    def _window(self, name: str) -> checks.Window:
        """The one-cycle means of a signal in the window, each at the middle of its cycle."""
        x = self._means(name, self.first, self.last)
        t = self.T_s * (self.first + np.arange(len(x), dtype=np.float64) + 0.5 * (self.width - 1))
        return checks.Window(name, t, x, self._before(name), self.at)

    # criteria

    def _stays_within(self, c: StaysWithin) -> Verdict:
        w = self._window(c.signal)
        scale = w.before if c.of_before else 1.0
        low, high = sorted_limits(c.low, c.high, scale)
        below, above = (np.full(len(w.t), np.nan if x is None else x) for x in (low, high))
        found = checks.envelope(w, below, above, c.longest_s)
        least, most = float(np.min(w.x)), float(np.max(w.x))
        room = {
            least: math.inf if low is None else least - low,
            most: math.inf if high is None else high - most,
        }
        value = min(room, key=lambda x: room[x])
        band = " and ".join(
            f"{word} {w.show(x)}"
            for word, x in (("at least", low), ("at most", high))
            if x is not None
        )
        if c.longest_s:
            band += f", but for {c.longest_s:g} s"
        beyond = checks.longest_beyond(w, below, above)
        stay = f"The one-cycle mean of {w.symbol} stays between {least:.4g} and {w.show(most)}"
        if found is not None and beyond > 0:
            text = f"{found.text} It was beyond for {beyond:.3g} s in one piece."
        elif beyond > 0:
            text = f"{stay}; it is beyond its limits for {beyond:.3g} s in one piece."
        else:
            text = f"{stay}."
        span = (self.first * self.T_s, self.last * self.T_s)
        return self._made(
            found is None, value, unit_of(c.signal), band, text, c.signal, low, high, span
        )

    def _settles(self, c: Settles) -> Verdict:
        w = self._window(c.signal)
        if c.to == "before":
            to, why = w.before, "its value before"
        elif c.to == "droop":
            asked = self._ending("ref_P_ref") + (1.0 - self._ending("omega_u")) / self.under.droop
            to = float(np.clip(asked, self.under.P_min, self.under.P_max))
            f = self._ending("omega_u") * self.f_n
            why = f"the declared droop of {100 * self.under.droop:g} % at {f:.4g} Hz"
            if to != asked:
                why += f", which asks for {asked:.3g} p.u., limited to the declared power"
        else:
            to, why = c.to, "the value asked for"
        if w.t[-1] < self.at + c.within:
            return self._cannot(f"its window ends before {c.within:g} s have passed")
        found = checks.settles(w, to, c.within, c.tolerance)
        took = checks.settled_after(w, to, c.tolerance)
        if found is None:
            text = f"{w.symbol} settles at {w.show(to)} ({why}) after {took:.3g} s."
        else:
            text = found.text.replace(
                f"{w.symbol} should settle at {w.show(to)}",
                f"The one-cycle mean of {w.symbol} should settle at {w.show(to)} ({why})",
                1,
            )
        return self._made(
            found is None, took, "s", f"within {c.within:g} s, ± {c.tolerance:g}", text, c.signal,
            to - c.tolerance, to + c.tolerance, (self.at + c.within, self.last * self.T_s),
        )  # fmt: skip

    def _way(self, direction: str) -> tuple[checks.Window, float, float]:
        """p, the sign of the direction, and how far its one-cycle means go there, p.u."""
        w, sign = self._window("p"), 1.0 if direction == "up" else -1.0
        return w, sign, float(np.max(sign * (w.x - w.before)))

    def _peak(self, c: PeakDelta) -> Verdict:
        w, sign, way = self._way(c.direction)
        ok = way >= c.least
        word = "rises" if c.direction == "up" else "falls"
        text = (
            f"The one-cycle mean of p {word} by {way:.3g} p.u. at its peak; at least {c.least:g} "
            f"p.u. is asked."
            if way > 0
            else f"p does not go {c.direction} at all; at least {c.least:g} p.u. is asked."
        )
        edge = w.before + sign * c.least
        span = (self.first * self.T_s, self.last * self.T_s)
        low, high = (edge, None) if sign > 0 else (None, edge)
        return self._made(ok, way, "p.u.", f"at least {c.least:g} p.u.", text, "p", low, high, span)

    def _rise(self, c: Rise) -> Verdict:
        w, sign, way = self._way(c.direction)
        if way < _NO_RISE:
            return self._cannot(f"p goes {c.direction} by {max(way, 0.0):.2g} p.u. only")
        goal = c.part * way
        gone = sign * (self._raw("p")[self.tick : self.last] - w.before)
        took = float(np.argmax(gone >= goal)) * self.T_s if (gone >= goal).any() else math.inf
        ok = took <= c.within + 1e-9
        text = (
            f"p has done {100 * c.part:g} % of the way to its peak of {way:.3g} p.u. after "
            f"{1e3 * took:.3g} ms; at most {1e3 * c.within:g} ms are allowed."
        )
        return self._made(ok, 1e3 * took, "ms", f"within {1e3 * c.within:g} ms", text, "p")

    def _damped(self, c: Damped) -> Verdict:
        w = self._window("p")
        acts = acting(self.run.scenario, self.run.columns, self.run.ticks)
        self.first = free_from(acts, self.first, self.last)
        if self.last - self.first < 2 * whole_ticks(self.width):
            return self._cannot("what the event does to the grid is not over within the window")
        raw = replace(
            w,
            x=self._raw("p")[self.first : self.last],
            t=self.T_s * np.arange(self.first, self.last, dtype=np.float64),
        )
        found = checks.damped(raw, c.ratio, self.T_s, self.f_n)
        mode = swing(raw.x, self.T_s, self.f_n)
        value = None if mode is None else mode.damping
        if found is not None:
            text = found.text
        elif mode is None:
            text = "p does not swing."
        else:
            text = f"The swing of p at {mode.hz:.3g} Hz has a damping ratio of {mode.damping:.3g}."
        return self._made(found is None, value, "", f"at least {c.ratio:g}", text, "p")

    def _energy(self, c: Energy) -> Verdict:
        p = self._raw("p")[self.first : self.last]
        dE = float(np.sum(p - self._before("p"))) * self.T_s
        H = -math.copysign(1.0, c.df_hz) * self.f_n * dE / (2 * abs(c.df_hz))
        text = (
            f"In the window p gives {dE:.3g} p.u. s more than before, as an inertia constant of "
            f"{H:.3g} s would; at least {c.least_s:g} s are asked."
        )
        return self._made(c.least_s <= H, H, "s", f"at least {c.least_s:g} s", text, "p")

    def _no_trip(self, c: NoTrip) -> Verdict:
        end, whole = self.run.ticks * self.T_s, self.run.scenario.ticks * self.T_s
        lost = {n: r for n, r in self.others.items() if r.status not in _LASTED}
        ok = self.run.status in _LASTED and self.run.ticks >= self.run.scenario.ticks and not lost
        if ok:
            text = f"Nothing trips in the {whole:g} s of the run."
        elif lost:
            name, other = next(iter(lost.items()))
            what = reason_name(other.summary["reason"])
            text = f"{name} ended at {other.ticks * self.T_s:.4g} s: {other.status}: {what}."
        else:
            text = f"The run should last {whole:g} s, but {self._end()}."
        return self._made(ok, end, "s", f"at least {whole:g} s", text)

    def _no_oscillation(self, c: NoOscillation) -> Verdict:
        scenario = self.run.scenario.model_copy(update={"expect_ripple": c.ripple})
        ripple = remaining_ripple(scenario, self.run.columns, self.run.events, self.run.ticks)
        if ripple is None:
            return self._cannot("the run is at rest for less than 0.2 s at its end")
        name = ripple.oscillates or max(ripple.pu, key=lambda n: ripple.pu[n])
        text = f"At the end {name} moves by {ripple.pu[name]:.2g} p.u. peak to peak at most."
        if ripple.oscillates:
            text = ripple.words()[0].upper() + ripple.words()[1:] + "."
        limit = f"at most {ripple.limit:g} p.u."
        return self._made(not ripple.oscillates, ripple.pu[name], "p.u.", limit, text, name)

    def _in_step(self, c: InStep) -> Verdict:
        delta = self._raw("delta")
        away = np.abs(delta[self.first : self.last] - delta[self.tick - 1])
        far = float(np.degrees(np.max(away)))
        text = (
            f"The angle to the grid is at most {far:.3g}° away from where it was."
            if far < 180
            else f"The converter falls out of step: its angle to the grid moves by {far:.4g}°."
        )
        return self._made(far < 180, far, "°", "less than 180°", text, "delta")

    def _in_envelope(self, c: InEnvelope) -> Verdict:
        declared, P_0 = self.under.unit, self._before("p")
        if declared is None:
            return self._cannot(
                "D, H and X_eff are not declared, and no swing equation fits the answer to a small "
                "phase jump"
            )
        unit = Unit(declared.D, declared.H, declared.X_eff)
        after = self.T_s * np.arange(self.last - self.tick, dtype=np.float64)
        found = self._expected(unit, after, P_0)
        if found is None:
            return self._cannot("its time is not that of an event with an envelope")
        if not np.isfinite([found.lower, found.upper]).all():
            return self._cannot(f"its envelope has no finite limits at H = {unit.H:.2g} s")
        if (droops := self._by_droop(P_0)) > 0.5 * float(np.min(found.upper - found.lower)):
            return self._cannot(
                "the envelope of a ramp knows no droop, and the declared one of "
                f"{100 * self.under.droop:g} % alone moves p by {droops:.3g} p.u."
            )
        # As DyCoV measures: the mean of the last cycle, and the limits are late by a cycle. In the
        # first one the mean is of before and after, and is not judged.
        cycle = whole_ticks(self.width)
        self.first = max(self.first, self.tick + cycle + 1)
        x = self._means("p", self.first - cycle, self.last)
        low, high = (y[self.first - self.tick :][: len(x)] for y in (found.lower, found.upper))
        t = self.T_s * (self.first + np.arange(len(low), dtype=np.float64))
        w = checks.Window("p", t, x[: len(low)], P_0, self.at)
        wrong = checks.envelope(w, low, high, c.longest_s)
        beyond = float(np.max(np.maximum(np.maximum(low - w.x, w.x - high), 0.0)))
        words = f"D = {unit.D:.3g}, H = {unit.H:.3g} s, X_eff = {unit.X_eff:.3g}"
        if wrong is None:
            text = f"p stays in the envelope of {words}" + (
                f", but for {beyond:.2g} p.u. for a time." if beyond > 0 else "."
            )
        else:
            text = f"{wrong.text} The envelope is that of {words}."
        every = max(1, len(t) // _CURVE)
        curve = t[::every], low[::every], high[::every]
        made = self._made(wrong is None, beyond, "p.u.", "beyond the envelope: 0 p.u.", text, "p")
        return replace(made, curve=curve)

    def _by_droop(self, P_0: float) -> float:
        """How far the declared droop moves p within the declared power, p.u.; 0 if the event at
        ``at`` is no ramp of the frequency."""
        ramps = [e for e in self.run.scenario.events if isinstance(e, GridFrequency) and e.rate]
        if not any(e.at(self.T_s) == self.tick for e in ramps):
            return 0.0
        omega_g = self._raw("omega_g")
        moved = (omega_g[self.tick - 1] - omega_g[self.last - 1]) / self.under.droop
        return float(abs(np.clip(P_0 + moved, self.under.P_min, self.under.P_max) - P_0))

    def _expected(self, unit: Unit, t: Vector, P_0: float) -> Envelope | None:
        """The envelope of the event at ``at``, or None if there is none; t: s after it."""
        scenario, scr = self.run.scenario, self.run.scenario.plant.grid.scr
        event = None
        for e in sorted(scenario.events, key=lambda e: e.at(self.T_s)):
            if e.at(self.T_s) == self.tick:
                event = e
            elif isinstance(e, GridImpedance) and e.at(self.T_s) < self.tick:
                scr = e.scr
        if scr is None:
            return None
        match event:
            case PhaseJump():
                return phase_jump(unit, t, math.radians(event.degrees), scr, P_0)
            case GridFrequency(rate=float(rate)):
                df = event.f_hz - self.f_n * float(self._raw("omega_g")[self.tick - 1])
                slope = math.copysign(rate / self.f_n, df)
                return rocof(unit, t, slope, scr, P_0, lasts=abs(df) / rate)
            case GridImpedance(scr=float(after)):
                return scr_jump(unit, t, scr, after, P_0)
        return None


def sorted_limits(
    low: float | None, high: float | None, scale: float
) -> tuple[float | None, float | None]:
    """Limits times a scale; of a negative one the lower is the upper."""
    low, high = (None if x is None else x * scale for x in (low, high))
    return (low, high) if scale >= 0 else (high, low)
