"""The base of all criteria: the clause of a test file, and the time of a run at which it is judged.

p, q and V are those at the connection point: behind the converter's transformer if it has one, else
at the filter. Powers, voltages, currents and frequencies are judged by their means over one cycle
of the nominal frequency (``run.cycles``); how fast a signal rises behind a low-pass at that
frequency, and the angle by every tick.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
import scipy  # loads scipy.signal, which takes as long as all the rest, when it is first used
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from gfm_hil.core.errors import UserError
from gfm_hil.core.schema import StrictSchema
from gfm_hil.recording.foreign import ABOUT
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.run import checks
from gfm_hil.run.cycles import cycle_means, cycle_ticks, whole_ticks
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, INFORMATIVE, PASS, Outcome, Verdict
from gfm_hil.studies.envelopes import Unit
from gfm_plant import Plant
from gfm_runtime import BuiltLaw

Vector = NDArray[np.float64]

_NEARLY_DC = 1e-9j  # rad/s
_OTHER_ERRORS = ("hybrid-angle",)  # error maps whose second error is an angle, not that of p
#: what a plant's keys are called on a first page, if not as in the file
_NAMES = {
    "lcl": "transformer [p.u.]", "i_peak": "peak-current limit [p.u.]", "adc": "A/D", "dac": "D/A",
    "dc_source": "DC source",
}  # fmt: skip
_ROUNDING = 1e-9  # p.u., s or Hz; the plant is solved to it


Known = Literal["read", "summary", "memory", "ours"]
#: how a limit is known, for people
KNOWN: dict[str, str] = {
    "read": "read",
    "summary": "from a summary; check the original",
    "memory": "from memory; check the original",
    "ours": "ours; no source gives it",
}


class Publication(StrictSchema):
    """Where a test or a limit comes from."""

    document: str = Field(min_length=1, description="name of the document")
    clause: str = Field(min_length=1, description="section, table or test in it")
    revision: str = Field(min_length=1, description="revision or year")
    known: Known = Field(description="how its content is known to us")

    def words(self) -> str:
        """Document, clause and revision in one line."""
        return f"{self.document}, {self.clause}, {self.revision}"


class UnderTest(StrictSchema):
    """The converter under test: its plant, and what its owner declares."""

    plant: Plant = Field(description="converter and instruments, without a grid")
    droop: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=True,
        description="declared: frequency over power in the steady state, p.u./p.u.; inf: none; "
        "that of the law itself, the gain from p to ω_u at rest, if not given",
    )
    P_max: float = Field(description="declared: most power in the steady state, p.u.")
    P_min: float = Field(description="declared: least power in the steady state, p.u.")
    unit: Unit | None = Field(
        None, description="declared, for in_envelope; measured by a small phase jump if none"
    )
    _measured: bool = PrivateAttr(False)

    @property
    def measured(self) -> bool:
        """Whether ``unit`` was measured, and not declared."""
        return self._measured

    def with_measured(self, unit: Unit) -> UnderTest:
        """A copy with a unit that was measured on this converter."""
        copy = self.model_copy(update={"unit": unit})
        copy._measured = True
        return copy

    @property
    def instruments(self) -> str:
        """The instruments that its file declares beside the converter, as one line."""
        declared = self.plant.model_dump(
            exclude_unset=True, exclude={"converter"}, exclude_none=True
        )
        words = {_NAMES.get(name, name): _plain(x).strip("{}") for name, x in declared.items()}
        if not words:
            return "an ideal plant: its file gives no delay, modulation, limit or protection"
        return "; ".join(map(": ".join, words.items()))


def own_droop(law: BuiltLaw) -> float:
    """The droop of a law, p.u./p.u.: its gain from p to omega_u at rest; inf: it has none, or the
    second error of its error map is not that of p."""
    gains = (law.element(matrix, (1, 1))(_NEARLY_DC).real for matrix in ("phi", "psi"))
    droop = 0.0 if law.error_map in _OTHER_ERRORS else sum(gains)
    return droop if 0 < droop < 1 else math.inf


class Clause(StrictSchema):
    """A clause of a test. Its windows count from each time in ``at``; ``window`` is [from, to]."""

    kind: str
    clause: str = Field(min_length=1, description="what the source asks, in its own words or short")
    at: list[float] | None = Field(
        None, min_length=1, description="s; the first event of the run if none"
    )
    source: Publication | None = Field(
        None, description="where it comes from, if not from where the test does"
    )
    known: Known | None = Field(
        None, description="how its limit is known, if not as its source is, such as ours"
    )
    informative: str | None = Field(
        None,
        min_length=1,
        description="why this clause can be judged for no law on the shipped converter; where it "
        "cannot be judged, it is informative and counts for nothing",
    )

    whole_run: ClassVar[bool] = False  # its window is the whole run
    judges_early_end: ClassVar[bool] = False  # it also judges a run that ended early
    alone: ClassVar[str] = ""  # why it cannot judge a converter of a network; empty: it can
    explains: ClassVar[int] = 2  # rank: a failure explains those of higher rank
    #: the verdicts that also hold for a recording whose samples are too far apart for the others,
    #: up to two cycles
    coarse: ClassVar[tuple[Outcome, ...]] = ()

    def judge(self, m: Moment) -> Verdict:
        """The verdict at one time of a run, whose window was recorded."""
        raise NotImplementedError

    def finest_s(self, cycle_s: float) -> float:
        """How far apart the samples of a recording may be for every verdict on it to hold, s."""
        return cycle_s / 20

    def of(self, test: Publication) -> Clause:
        """The clause with its source filled in, from that of its test."""
        source = self.source or test
        known = self.known or source.known
        return self.model_copy(update={"source": source, "known": known})

    def limits(self) -> str:
        """All limits in the words of the test file, for lists."""
        own = [key for key in type(self).model_fields if key not in (*Clause.model_fields, "kind")]
        limits = {key: getattr(self, key) for key in own}
        return ", ".join(
            f"{k} = {_plain(x)}" for k, x in limits.items() if x not in (None, [], False)
        )

    def with_source(self, verdict: Verdict) -> Verdict:
        """A verdict with the source of its clause."""
        words = "" if self.source is None else self.source.words()
        return replace(verdict, source=words, known=self.known or "")

    def declare(self, under: UnderTest, scenario: Scenario) -> UnderTest:
        """The owner's declarations, with measured values of what this clause needs besides."""
        return under


def _plain(x: object) -> str:
    """A value of a file as one line."""
    if isinstance(x, StrictSchema):
        return _plain(x.model_dump(exclude_none=True))
    if isinstance(x, dict):
        return "{" + ", ".join(f"{k} = {_plain(v)}" for k, v in x.items()) + "}"
    if isinstance(x, list | tuple):
        return "[" + ", ".join(map(_plain, x)) + "]"
    return f"{x:g}" if isinstance(x, float) else str(x)


class Windowed(Clause):
    """A clause with a window."""

    window: tuple[float, float] | None = Field(
        None, strict=False, description="s after at; up to the next event or the end if none"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Windowed:
        if self.window is not None and not 0 <= self.window[0] < self.window[1]:
            raise ValueError(f"window = {list(self.window)}: must be [from, to], 0 <= from < to")
        return self


class Moment:
    """One time of a finished run at which a clause is judged.

    Attributes:
        at, tick: the time, s, and its tick.
        first, last: ticks of the window; a run that ended early may lack the last ones.
        width: ticks of a cycle; not a whole number.
        others: runs of the other converters of a network, by name.
        recording: how it was recorded, of a recording; empty of a run.
    """

    def __init__(
        self, run: Run, under: UnderTest, others: Mapping[str, Run], clause: Clause, at: float
    ) -> None:
        self.run, self.under, self.others, self.clause = run, under, others, clause
        self.T_s = run.scenario.T_s
        self.f_n = nominal_frequency(run.scenario)
        self.width = cycle_ticks(self.T_s, self.f_n)
        self.recording: Mapping[str, Any] = run.summary.get(ABOUT, {})
        self.at, self.tick = at, round(at / self.T_s)
        whole = run.scenario.ticks
        later = [e.at(self.T_s) for e in run.scenario.events if e.at(self.T_s) > self.tick]
        self.first, self.last = self.tick, min(later, default=whole)
        if (window := getattr(clause, "window", None)) is not None:
            self.first, self.last = (self.tick + round(x / self.T_s) for x in window)
        if clause.whole_run:
            self.tick = self.first = 0
            self.last = whole

    def verdict(self) -> Verdict:
        """The verdict; a window that the run did not reach cannot be judged."""
        if not self.clause.judges_early_end:
            if self.run.ticks < self.last:
                return self.cannot_judge(f"{self.end()}, before the end of the window")
            if self.last - self.first < 2 * whole_ticks(self.width):
                return self.cannot_judge("the window is shorter than two cycles")
            if not self.clause.whole_run and self.tick < whole_ticks(self.width):
                return self.cannot_judge("no whole cycle was recorded before the event")
        return self._of_recording() if self.recording else self.clause.judge(self)

    def _of_recording(self) -> Verdict:
        """The verdict on a recording; what it cannot show cannot be judged."""
        apart, cycle = self.recording["resolution_s"], 1 / self.f_n
        finest = self.clause.finest_s(cycle)
        too_coarse = f"what the recording shows is {1e3 * apart:.3g} ms apart, and it takes "
        if apart > 2 * cycle or (apart > finest and not self.clause.coarse):
            return self.cannot_judge(f"{too_coarse}{1e3 * finest:.3g} ms")
        try:
            verdict = self.clause.judge(self)
        except UserError as problem:
            return self.cannot_judge(str(problem))
        if apart > finest and verdict.verdict not in (*self.clause.coarse, CANNOT, INFORMATIVE):
            return self.cannot_judge(
                f"{too_coarse}{1e3 * finest:.3g} ms for more than: {verdict.text.rstrip('.')}"
            )
        return verdict

    def make_verdict(
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
        """A verdict on the window; arguments as the attributes of ``Verdict``. A value within
        rounding is 0."""
        if value is not None and abs(value) < _ROUNDING:
            value = 0.0
        return Verdict(
            self.clause.clause, self.clause.kind, signal,
            round(self.first * self.T_s, 9), round(self.last * self.T_s, 9),
            PASS if ok else FAIL, value, unit, limit, f"{text.rstrip('.')}.", low, high, limited,
        )  # fmt: skip

    def cannot_judge(self, reason: str) -> Verdict:
        """The verdict that the clause cannot be judged, or is informative, for this reason."""
        why = self.clause.informative
        text = f"Cannot be judged: {reason}" + (f" (informative: {why})." if why else ".")
        verdict = self.make_verdict(True, None, "", "", text, getattr(self.clause, "signal", ""))
        return replace(verdict, verdict=CANNOT if why is None else INFORMATIVE)

    def end(self) -> str:
        """How the run ended early."""
        summary = self.run.summary
        return (
            f"the run ended at {self.run.ticks * self.T_s:.4g} s ({summary['status']}: "
            f"{reason_name(summary['reason'])})"
        )

    @property
    def droop(self) -> float:
        """The declared droop, p.u./p.u.; inf: none. Raises UserError: it is that of a
        recording, which has no law to compute it from, and none is declared."""
        if self.under.droop is None and self.recording:
            raise UserError("its converter declares no droop; give one, or inf, by --converter")
        return math.inf if self.under.droop is None else self.under.droop

    @property
    def span(self) -> tuple[float, float]:
        """From when to when the window lasts, s."""
        return self.first * self.T_s, self.last * self.T_s

    def raw(self, name: str) -> Vector:
        """Every tick of a signal. Raises UserError: a recording has none, or not all that counts
        from the cycle before the event, or before the window, to its end."""
        if self.recording:
            since = min(self.tick, self.first) - whole_ticks(self.width)
            self.check(name, since, self.last)
        return np.asarray(self.run.signals[at_connection(self.run, name)], np.float64)

    def check(self, name: str, first: int, last: int) -> None:
        """Raise UserError unless a recording has a signal at all ticks from first to last."""
        if name not in self.run.signals:
            raise UserError(f"the recording has no {name}")
        if np.isnan(self.run.signals[name][max(0, first) : last]).any():
            raise UserError(f"the recording does not have all of {name} in the window")

    def means(self, name: str, first: int, last: int) -> Vector:
        """The one-cycle means of a signal over ticks first to last, in its unit."""
        return self.mean_of(self.raw(name)[first:last])

    def mean_of(self, x: Vector) -> Vector:
        """The one-cycle means of ticks, one for each at which a whole cycle begins, (m,)."""
        return np.concatenate([np.empty(0), *cycle_means(x, 0, len(x), self.width)])

    def before(self, name: str) -> float:
        """The mean of the last cycle before the event."""
        return float(self.means(name, self.tick - whole_ticks(self.width), self.tick)[0])

    def mean_at_end(self, name: str) -> float:
        """The mean of the last cycle of the window."""
        return float(self.means(name, self.last - whole_ticks(self.width), self.last)[0])

    def window(self, name: str) -> checks.Window:
        """The one-cycle means of a signal in the window, each at the middle of its cycle."""
        x = self.means(name, self.first, self.last)
        t = self.T_s * (self.first + np.arange(len(x), dtype=np.float64) + 0.5 * (self.width - 1))
        return checks.Window(name, t, x, self.before(name), self.at)

    def low_passed(self, name: str, first: int, last: int) -> Vector:
        """A signal of some ticks behind a low-pass of first order at the nominal frequency, which
        begins at the mean before the event."""
        x, before = self.raw(name)[first:last], self.before(name)
        a = math.exp(-2 * math.pi * self.f_n * self.T_s)
        return before + np.asarray(scipy.signal.lfilter([1 - a], [1, -a], x - before))

    def excursion(self, name: str, direction: str) -> tuple[checks.Window, float, float]:
        """The window of a signal, the sign of "up" or "down", and the largest change of its
        one-cycle means in that direction, in its unit."""
        w, sign = self.window(name), 1.0 if direction == "up" else -1.0
        return w, sign, float(np.max(sign * (w.x - w.before)))


def at_connection(run: Run, name: str) -> str:
    """The name of a signal at the connection point, if that is another one than at the filter."""
    return f"{name}_c" if f"{name}_c" in run.signals else name


def judge(
    run: Run, criteria: Sequence[Clause], under: UnderTest, others: Mapping[str, Run] | None = None
) -> list[Verdict]:
    """The verdicts of all criteria of a test and its part, each at each of its times; the runs of
    the other converters of a network must not trip either."""
    T_s, events = run.scenario.T_s, run.scenario.events
    first = min((e.at(T_s) * T_s for e in events), default=0.0)
    return [
        criterion.with_source(Moment(run, under, others or {}, criterion, at).verdict())
        for criterion in criteria
        for at in criterion.at or [first]
    ]


def cannot_judge(criteria: Sequence[Clause], reason: str) -> list[Verdict]:
    """Verdicts on a run that did not take place, or none of a part without criteria."""
    return [
        c.with_source(
            Verdict(
                c.clause, c.kind, getattr(c, "signal", ""), at, at, CANNOT, None, "", "", reason
            )
        )
        for c in criteria
        for at in c.at or [0.0]
    ]
