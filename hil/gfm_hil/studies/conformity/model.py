"""A conformity test as data: its source, the run, and what is asked clause by clause.

A test is one TOML file. Its runs are scenarios in the scenario's own language, without a law; a
test may have several parts, each of which changes some of the scenario and is a run of its own.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gfm_plant import Plant

Known = Literal["read", "summary", "memory", "own"]

#: how the source of a test is known, for people
KNOWN: dict[str, str] = {
    "read": "read",
    "summary": "from a summary; check the original",
    "memory": "from memory; check the original",
    "own": "our own choice",
}


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class Source(_Model):
    """Where a test comes from."""

    document: str = Field(min_length=1, description="name of the document")
    clause: str = Field(min_length=1, description="section, table or test in it")
    revision: str = Field(min_length=1, description="revision or year")
    known: Known = Field(description="how its content is known to us")

    def words(self) -> str:
        """Document, clause and revision in one line."""
        return f"{self.document}, {self.clause}, {self.revision}"


class _Criterion(_Model):
    """A clause. Its windows count from each time in ``at``; ``window`` is [from, to]."""

    clause: str = Field(min_length=1, description="what the source asks, in its own words or short")
    at: list[float] | None = Field(
        None, min_length=1, description="s; the first event of the run if none"
    )
    informative: str | None = Field(
        None,
        min_length=1,
        description="why this clause can be judged for no law on the shipped converter; where it "
        "cannot be judged, it is informative and counts for nothing",
    )


class _Windowed(_Criterion):
    window: tuple[float, float] | None = Field(
        None, strict=False, description="s after at; up to the next event or the end if none"
    )

    @model_validator(mode="after")
    def _ordered(self) -> _Windowed:
        if self.window is not None and not 0 <= self.window[0] < self.window[1]:
            raise ValueError(f"window = {list(self.window)}: must be [from, to], 0 <= from < to")
        return self


class StaysWithin(_Windowed):
    """The one-cycle means of a signal stay between two limits."""

    kind: Literal["stays_within"] = Field(description="kind of criterion")
    signal: str = Field("p", description="p, q, V, i, v_dc, f_hz or another recorded signal")
    low: float | None = Field(None, description="in the unit of the signal, p.u. or Hz")
    high: float | None = Field(None, description="in the unit of the signal, p.u. or Hz")
    of_before: bool = Field(
        False, description="low and high are parts of the mean of the last cycle before at"
    )
    longest_s: float = Field(0.0, ge=0, description="s that the signal may be beyond, in one piece")

    @model_validator(mode="after")
    def _limited(self) -> StaysWithin:
        if self.low is None and self.high is None:
            raise ValueError("low, high: give one of them or both")
        return self


class Settles(_Windowed):
    """The one-cycle means of a signal come within a tolerance of a value and stay there."""

    kind: Literal["settles"] = Field(description="kind of criterion")
    signal: str = Field("p", description="as for stays_within")
    to: float | Literal["before", "droop"] = Field(
        description="value; before: the mean of the last cycle before at; droop: where the "
        "declared droop and power limits put p at the frequency that the converter has"
    )
    tolerance: float = Field(gt=0, description="in the unit of the signal")
    within: float = Field(gt=0, description="s after at")


class PeakDelta(_Windowed):
    """The one-cycle means of p move by at least so much from before, in the given direction."""

    kind: Literal["peak_delta_p"] = Field(description="kind of criterion")
    least: float = Field(gt=0, description="p.u.")
    direction: Literal["up", "down"] = Field(description="in which direction p must move")


class Rise(_Windowed):
    """p has done a part of its way to the peak of its one-cycle means within a time; every tick
    counts, since a mean over a cycle would hide it."""

    kind: Literal["rise_within"] = Field(description="kind of criterion")
    part: float = Field(0.9, gt=0, lt=1, description="of the way to the peak")
    within: float = Field(gt=0, description="s after at")
    direction: Literal["up", "down"] = Field(description="in which direction p must move")


class Damped(_Windowed):
    """The swing of p after the event has at least a damping ratio, and at most another one."""

    kind: Literal["damped"] = Field(description="kind of criterion")
    ratio: float = Field(description="least damping ratio")


class Energy(_Windowed):
    """The inertia constant that the energy given in a change of frequency shows,
    H = f_n dE / (2 abs(df)) with dE the integral of p beyond what it was before."""

    kind: Literal["energy"] = Field(description="kind of criterion")
    df_hz: float = Field(description="change of the grid's frequency in the window, Hz")
    least_s: float = Field(gt=0, description="least inertia constant, s")


class NoTrip(_Criterion):
    """The run lasts to its end: no protection trips, and the controller does not go to SAFE."""

    kind: Literal["no_trip"] = Field(description="kind of criterion")


class NoOscillation(_Criterion):
    """At the end of the run p, V, omega_u and the current are at rest."""

    kind: Literal["no_oscillation"] = Field(description="kind of criterion")
    ripple: float = Field(0.02, gt=0, description="p.u. peak to peak of the strongest sinusoid")


class InStep(_Windowed):
    """The angle to the grid stays within half a turn of where it was before."""

    kind: Literal["stays_in_step"] = Field(description="kind of criterion")


class InEnvelope(_Windowed):
    """The means of p over the last cycle stay in the envelope that DyCoV draws around what a unit
    of the declared or measured damping, inertia and reactance is expected to do. The event at the
    time is a phase jump, a ramp of the grid's frequency or a jump of its short-circuit ratio."""

    kind: Literal["in_envelope"] = Field(description="kind of criterion")
    longest_s: float = Field(0.0, ge=0, description="s that p may be beyond, in one piece")


class Band(_Model):
    """Limits of a gain and a phase between two frequencies."""

    from_hz: float = Field(gt=0, description="of the perturbation, Hz")
    to_hz: float = Field(gt=0, description="the same")
    low: float | None = Field(None, description="least gain, p.u. of power over p.u. of frequency")
    high: float | None = Field(None, description="largest gain, in the same unit")
    phase_low: float | None = Field(None, description="least phase, degrees from -180 to 180")
    phase_high: float | None = Field(None, description="largest phase, in the same unit")

    @model_validator(mode="after")
    def _limited(self) -> Band:
        if self.from_hz >= self.to_hz:
            raise ValueError(f"from_hz = {self.from_hz:g}: must be < to_hz = {self.to_hz:g}")
        if {self.low, self.high, self.phase_low, self.phase_high} == {None}:
            raise ValueError("low, high, phase_low, phase_high: give one of them")
        return self


class Nfp(_Criterion):
    """The network-frequency-perturbation plot, measured by small sines of the grid's frequency:
    gain and phase of the change of p over the change of the grid's frequency stay within bands. A
    part with this criterion has no other one, and no events count."""

    kind: Literal["nfp"] = Field(description="kind of criterion")
    from_hz: float = Field(1.0, ge=0.01, description="lowest frequency of the plot, Hz")
    to_hz: float = Field(100.0, gt=0, description="highest frequency of the plot, Hz")
    points: int = Field(21, ge=2, le=1000, description="evenly apart on a logarithmic axis")
    bands: list[Band] = Field([], description="limits; each gives a verdict")
    unknown: str | None = Field(
        None, description="without bands: why none are known; the plot is drawn, and informative"
    )

    @model_validator(mode="after")
    def _judged_or_not(self) -> Nfp:
        if bool(self.bands) == (self.unknown is not None):
            raise ValueError("bands, unknown: give one of them")
        if self.at is not None:
            raise ValueError("at: a plot has no time")
        if not self.from_hz < self.to_hz:
            raise ValueError(f"from_hz = {self.from_hz:g}: must be < to_hz = {self.to_hz:g}")
        for band in self.bands:
            if not self.from_hz <= band.from_hz < band.to_hz <= self.to_hz:
                raise ValueError(f"bands: from {band.from_hz:g} Hz: must lie in the plot")
        return self


Criterion = Annotated[
    StaysWithin
    | Settles
    | PeakDelta
    | Rise
    | Damped
    | Energy
    | NoTrip
    | NoOscillation
    | InStep
    | InEnvelope
    | Nfp,
    Field(discriminator="kind"),
]


class Part(_Model):
    """One run of a test that has several."""

    name: str = Field(pattern=r"^[A-Za-z0-9.+-]+$", description="letters, digits, . + -")
    title: str = Field("", description="for people")
    scenario: dict[str, Any] = Field(
        {}, description="keys of the scenario that this part changes; a list is replaced"
    )
    criteria: list[Criterion] = Field([], description="besides those of the test")
    cannot: str | None = Field(
        None, description="why the bench cannot run this part; its clauses cannot be judged"
    )

    @model_validator(mode="after")
    def _asks_what_it_can(self) -> Part:
        if self.cannot is not None and (self.scenario or self.criteria):
            raise ValueError("cannot: such a part has neither scenario nor criteria")
        return self


class Test(_Model):
    """The whole file."""

    __test__ = False  # none of pytest's

    title: str = Field(min_length=1, description="of tables and figures")
    description: str = Field("", description="what is done, and what of it is our choice")
    source: Source = Field(description="where the test comes from")
    f_n: float = Field(ge=1, le=1000, description="nominal frequency, Hz; the converter follows it")
    ratings: dict[str, Annotated[float, Field(ge=1e-3, le=1e3)]] = Field(
        {}, description="in a network: rating of a converter over that under test"
    )
    judged: str | None = Field(
        None, description="in a network: the converter whose signals are judged"
    )
    scenario: dict[str, Any] = Field(
        description="the run: keys of a scenario file but for title, law, inner and link"
    )
    criteria: list[Criterion] = Field([], description="what is asked of every part")
    parts: list[Part] = Field([], description="runs of the test; one if none")

    def runs(self) -> list[Part]:
        """The parts, or the only run as a part without a name."""
        return self.parts or [Part.model_construct(name="", title="", cannot=None)]

    @model_validator(mode="after")
    def _fits_together(self) -> Test:
        names = [part.name for part in self.parts]
        if len(set(names)) < len(names):
            raise ValueError(f"parts: names {names}: each once")
        for part in self.runs():
            asked = [*self.criteria, *part.criteria]
            if any(isinstance(c, Nfp) for c in asked) and len(asked) > 1:
                raise ValueError(f"parts {part.name!r}: nfp: must be its only criterion")
            if part.cannot is None and not asked:
                raise ValueError(f"parts {part.name!r}: no criterion; give some to it or the test")
        own = sorted({"title", "law", "inner", "link", "mode"} & {*self.scenario})
        if own:
            raise ValueError(f"scenario.{own[0]}: is not the test's to set")
        return self


class Declared(_Model):
    """The grid-forming unit that the converter is declared to be."""

    D: float = Field(ge=0, description="damping, p.u. of power over p.u. of frequency")
    H: float = Field(gt=0, description="inertia constant, s")
    X_eff: float = Field(gt=0, description="effective reactance, p.u.")


class UnderTest(_Model):
    """The converter under test: its plant, and what its owner declares."""

    plant: Plant = Field(description="converter and instruments, without a grid")
    droop: float = Field(
        gt=0,
        allow_inf_nan=True,
        description="declared: frequency over power in the steady state, p.u./p.u.; inf: none",
    )
    P_max: float = Field(description="declared: most power in the steady state, p.u.")
    P_min: float = Field(description="declared: least power in the steady state, p.u.")
    unit: Declared | None = Field(
        None, description="declared, for in_envelope; measured by a small phase jump if none"
    )
