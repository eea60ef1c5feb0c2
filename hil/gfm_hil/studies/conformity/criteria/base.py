"""What all criteria share: the clause of a test file, and the moment of a run at which it is
judged.

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
        """The same with a unit that was measured on it."""
        made = self.model_copy(update={"unit": unit})
        made._measured = True
        return made

    @property
    def instruments(self) -> str:
        """What its file says of the plant besides the converter, in words."""
        told = self.plant.model_dump(exclude_unset=True, exclude={"converter"}, exclude_none=True)
        words = {_NAMES.get(name, name): _plain(x).strip("{}") for name, x in told.items()}
        if not words:
            return "an ideal plant: its file gives no delay, modulation, limit or protection"
        return "; ".join(map(": ".join, words.items()))


def own_droop(law: BuiltLaw) -> float:
    """The frequency over the power at rest, p.u./p.u.: a law's gain from p to omega_u; inf: it has
    none, or its errors are others than those of p."""
    gains = (law.element(matrix, (1, 1))(_NEARLY_DC).real for matrix in ("phi", "psi"))
    found = 0.0 if law.error_map in _OTHER_ERRORS else sum(gains)
    return found if 0 < found < 1 else math.inf


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

    whole_run: ClassVar[bool] = False  # it is about the whole run, whatever its events
    of_cut_run: ClassVar[bool] = False  # a run that ended early can be judged too
    alone: ClassVar[str] = ""  # why it judges a converter alone only, and none of a network
    explains: ClassVar[int] = 2  # the failure of one with a smaller number explains those of others
    #: the verdicts that hold of a recording too coarse for more: of samples up to two cycles apart
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
        told = {key: getattr(self, key) for key in own}
        return ", ".join(
            f"{k} = {_plain(x)}" for k, x in told.items() if x not in (None, [], False)
        )

    def sourced(self, verdict: Verdict) -> Verdict:
        """A verdict with the source of its clause."""
        words = "" if self.source is None else self.source.words()
        return replace(verdict, source=words, known=self.known or "")

    def declared(self, under: UnderTest, scenario: Scenario) -> UnderTest:
        """What the owner declares, with what is measured in its place where it is missing."""
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
    """One time of a finished run at which a clause is judged: ``at`` s and its tick, and the ticks
    of the window, first to last. The run may have ended early; the others are those of the other
    converters of a network. ``width`` is that of a cycle in ticks; not a whole number."""

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
        if not self.clause.of_cut_run:
            if self.run.ticks < self.last:
                return self.cannot(f"{self.end()}, before the end of the window")
            if self.last - self.first < 2 * whole_ticks(self.width):
                return self.cannot("the window is shorter than two cycles")
            if not self.clause.whole_run and self.tick < whole_ticks(self.width):
                return self.cannot("no whole cycle was recorded before the event")
        return self._of_recording() if self.recording else self.clause.judge(self)

    def _of_recording(self) -> Verdict:
        """The verdict on a recording; what it cannot show cannot be judged."""
        apart, cycle = self.recording["resolution_s"], 1 / self.f_n
        finest = self.clause.finest_s(cycle)
        told = f"what the recording shows is {1e3 * apart:.3g} ms apart, and it takes "
        if apart > 2 * cycle or (apart > finest and not self.clause.coarse):
            return self.cannot(f"{told}{1e3 * finest:.3g} ms")
        try:
            found = self.clause.judge(self)
        except UserError as problem:
            return self.cannot(str(problem))
        if apart > finest and found.verdict not in (*self.clause.coarse, CANNOT, INFORMATIVE):
            return self.cannot(
                f"{told}{1e3 * finest:.3g} ms for more than: {found.text.rstrip('.')}"
            )
        return found

    def says(
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

    def cannot(self, reason: str) -> Verdict:
        """That it cannot be judged, or is informative, and why."""
        why = self.clause.informative
        text = f"Cannot be judged: {reason}" + (f" (informative: {why})." if why else ".")
        made = self.says(True, None, "", "", text, getattr(self.clause, "signal", ""))
        return replace(made, verdict=CANNOT if why is None else INFORMATIVE)

    def end(self) -> str:
        """How the run ended early."""
        summary = self.run.summary
        return (
            f"the run ended at {self.run.ticks * self.T_s:.4g} s ({summary['status']}: "
            f"{reason_name(summary['reason'])})"
        )

    @property
    def droop(self) -> float:
        """The declared droop, p.u./p.u.; inf: none. Raises UserError: it is a recording's, which
        has no law that tells it, and none is declared."""
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
        """See that a recording has a signal at some ticks. Raises UserError: it has not."""
        if name not in self.run.signals:
            raise UserError(f"the recording has no {name}")
        if np.isnan(self.run.signals[name][max(0, first) : last]).any():
            raise UserError(f"the recording does not have all of {name} in the window")

    def means(self, name: str, first: int, last: int) -> Vector:
        """The one-cycle means of a signal that lie within some ticks."""
        return self.mean_of(self.raw(name)[first:last])

    def mean_of(self, x: Vector) -> Vector:
        """The one-cycle means of some ticks."""
        return np.concatenate([np.empty(0), *cycle_means(x, 0, len(x), self.width)])

    def before(self, name: str) -> float:
        """The mean of the last cycle before the event."""
        return float(self.means(name, self.tick - whole_ticks(self.width), self.tick)[0])

    def ending(self, name: str) -> float:
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

    def way(self, name: str, direction: str) -> tuple[checks.Window, float, float]:
        """A signal, the sign of "up" or "down", and how far its one-cycle means go there."""
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
        criterion.sourced(Moment(run, under, others or {}, criterion, at).verdict())
        for criterion in criteria
        for at in criterion.at or [first]
    ]


def cannot(criteria: Sequence[Clause], reason: str) -> list[Verdict]:
    """Verdicts on a run that did not take place, or none of a part without criteria."""
    return [
        c.sourced(
            Verdict(
                c.clause, c.kind, getattr(c, "signal", ""), at, at, CANNOT, None, "", "", reason
            )
        )
        for c in criteria
        for at in c.at or [0.0]
    ]
