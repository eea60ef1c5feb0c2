"""The events of a scenario, one pydantic model per kind.

An event has a time ``t`` [s] or a ``tick``. The controller carries out references and law changes,
the plant all events of the grid; each side selects its own.
"""

from __future__ import annotations

import cmath
import math
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gfm_plant.names import FAULTED_PHASES
from gfm_runtime import law_titles
from gfm_runtime.signals import SIGNALS

if TYPE_CHECKING:  # an operator's command loads no compiler
    from gfm_plant import Network

_REFERENCE = {s.name: s for s in SIGNALS if s.group == "ref"}


class _Event(BaseModel):
    """The time of an event; each kind adds its fields and a short ``label`` for figures and
    reports."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    t: float | None = Field(None, ge=0, le=86400, description="time of the event, s")
    tick: int | None = Field(
        None, ge=0, le=86_400_000_000, description="tick of the event, in place of t"
    )

    @model_validator(mode="after")
    def _one_time(self) -> _Event:
        if (self.t is None) == (self.tick is None):
            raise ValueError(f"t = {self.t}, tick = {self.tick}: give one of them")
        return self

    def at(self, T_s: float) -> int:
        """The tick of the event; a time is rounded to the nearest tick."""
        return self.tick if self.tick is not None else round((self.t or 0.0) / T_s)

    def lasts(self) -> float:
        """How long it acts, s, if the event itself says so; 0 for a step and for what stays."""
        return float(getattr(self, "duration", None) or getattr(self, "ramp_s", None) or 0.0)


def reference_field(name: str, default: float | None) -> Any:
    """A field for a reference, described as in the signal table."""
    s = _REFERENCE[name]
    return Field(default, description=f"{s.description}, {s.low:g} to {s.high:g} {s.unit}")


_WHOSE = "in a network: which converter it is for; all of them if none"


class Reference(_Event):
    """New references; ``ramp_s`` spreads the change over a time instead of one tick."""

    type: Literal["reference"] = Field(description="kind of event")
    V_dcref: float | None = reference_field("V_dcref", None)
    P_ref: float | None = reference_field("P_ref", None)
    omega_g: float | None = reference_field("omega_g", None)
    Q_ref: float | None = reference_field("Q_ref", None)
    V_ref: float | None = reference_field("V_ref", None)
    converter: str | None = Field(None, description=_WHOSE)
    ramp_s: float = Field(0.0, ge=0, description="spreads the change evenly over so many seconds")

    @model_validator(mode="after")
    def _in_range(self) -> Reference:
        if not self.values():
            raise ValueError(f"no reference given: use {sorted(_REFERENCE)}")
        for name, value in self.values().items():
            check_reference(name, value)
        return self

    def values(self) -> dict[str, float]:
        """The references given."""
        return {n: v for n in _REFERENCE if (v := getattr(self, n)) is not None}

    def label(self) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in self.values().items())


def check_reference(name: str, value: float) -> None:
    """Raise ValueError if a reference lies outside its range in the signal table."""
    s = _REFERENCE[name]
    if not s.low <= value <= s.high:
        raise ValueError(f"{name} = {value}: must lie in [{s.low:g}, {s.high:g}] {s.unit}")


class LawChange(_Event):
    """Change to another law, without a bump."""

    type: Literal["law"] = Field(description="kind of event")
    law: str = Field(description="catalogue name or law file")
    converter: str | None = Field(None, description=_WHOSE)

    def label(self) -> str:
        return f"law {law_titles([self.law])[self.law]}"


class Gains(_Event):
    """New gains of the active law, by the names in its file, without a bump. Tied parameters
    follow."""

    type: Literal["gains"] = Field(description="kind of event")
    values: dict[str, float] = Field(
        min_length=1, description="a table of names and numbers, e.g. { D_p = 0.02 }"
    )
    converter: str | None = Field(None, description=_WHOSE)

    def label(self) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in self.values.items())


class Reset(_Event):
    """Return from a trip or the safe state to the scenario's start, for runs that wait there. A
    converter of a network starts again in the network as it is by then."""

    type: Literal["reset"] = Field(description="kind of event")
    converter: str | None = Field(None, description=_WHOSE)

    def label(self) -> str:
        return "reset"


class GridFrequency(_Event):
    """Grid frequency: a step, or a ramp at ``rate`` [Hz/s]."""

    type: Literal["grid-frequency"] = Field(description="kind of event")
    f_hz: float = Field(gt=0, le=1000, description="Hz")
    rate: float | None = Field(None, gt=0, description="Hz/s; a step if none")

    def label(self) -> str:
        return f"grid {self.f_hz:g} Hz" + (f" at {self.rate:g} Hz/s" if self.rate else "")


class GridVoltage(_Event):
    """Grid voltage [p.u.]: a step, a ramp at ``rate`` [p.u./s], or a sag of ``duration`` [s]."""

    type: Literal["grid-voltage"] = Field(description="kind of event")
    V_g: float = Field(ge=0, le=1.5, description="p.u.")
    rate: float | None = Field(None, gt=0, description="p.u./s; a step if none")
    duration: float | None = Field(None, gt=0, description="s; then the voltage returns (a sag)")

    @model_validator(mode="after")
    def _ramp_or_sag(self) -> GridVoltage:
        if self.rate is not None and self.duration is not None:
            raise ValueError(f"rate = {self.rate}, duration = {self.duration}: a ramp or a sag")
        return self

    def label(self) -> str:
        return f"grid {self.V_g:g} p.u." + (f" for {self.duration:g} s" if self.duration else "")


class GridProfile(_Event):
    """The grid's frequency and voltage follow a CSV file: t [s after the event], and f_hz [Hz] or
    omega_g [p.u.], V_g [p.u.], or both; straight between its lines, and at the end they stay."""

    type: Literal["grid-profile"] = Field(description="kind of event")
    file: str = Field(
        min_length=1, description="path, from the scenario's folder or where you run the command"
    )

    def lasts(self) -> float:
        from gfm_hil.scenario.profiles import last_time

        return last_time(self.file)

    def label(self) -> str:
        return f"grid profile {PurePath(self.file).stem}"


class PhaseJump(_Event):
    """The grid's angle jumps ahead by ``degrees``."""

    type: Literal["grid-phase-jump"] = Field(description="kind of event")
    degrees: float = Field(ge=-180, le=180, description="by which the grid's angle jumps ahead")

    def label(self) -> str:
        return f"phase jump {self.degrees:g}°"


class GridImpedance(_Event):
    """The line becomes ``L_g`` and ``R_g`` times its nominal elements, or one of a short-circuit
    ratio ``scr`` with ``x_over_r``, as ``plant.grid`` has them."""

    type: Literal["grid-impedance"] = Field(description="kind of event")
    L_g: float | None = Field(
        None, gt=0, le=1e12, description="factor on the converter file's line inductor"
    )
    R_g: float | None = Field(
        None, ge=0, le=1e12, description="factor on the converter file's line resistor"
    )
    scr: float | None = Field(
        None, gt=0, le=1e6, description="short-circuit ratio at the point of connection"
    )
    x_over_r: float | None = Field(
        None, gt=0, le=1e6, description="X/R of the line at nominal frequency; goes with scr"
    )

    @model_validator(mode="after")
    def _is_whole(self) -> GridImpedance:
        names = ("L_g", "R_g", "scr", "x_over_r")
        given = [name for name in names if getattr(self, name) is not None]
        if given not in (["L_g", "R_g"], ["scr", "x_over_r"]):
            raise ValueError(
                f"{', '.join(given) or 'nothing'} given: give L_g and R_g, or scr and x_over_r"
            )
        return self

    def factors(self, plant: Network) -> tuple[float, float]:
        """Of the line's nominal L and R.

        Raises:
            ValueError: the converter's line has no resistance that a factor could change.
        """
        if self.L_g is not None and self.R_g is not None:
            return self.L_g, self.R_g
        from gfm_plant.options import Grid

        line, r = Grid(scr=self.scr, x_over_r=self.x_over_r).line(), plant.par[0]
        assert line is not None
        if r["R_line_n"] == 0.0:
            raise ValueError(f"x_over_r = {self.x_over_r}: needs a converter file with R_g > 0")
        return line["L_g"] / float(r["L_line_n"]), line["R_g"] / float(r["R_line_n"])

    def label(self) -> str:
        if self.scr is not None:
            return f"SCR {self.scr:g}, X/R {self.x_over_r:g}"
        return f"line L × {self.L_g:g}, R × {self.R_g:g}"


class GridLoad(_Event):
    """The load of a finite grid changes by ``change`` [p.u. of the grid's rating]."""

    type: Literal["grid-load"] = Field(description="kind of event")
    change: float = Field(ge=-2, le=2, description="p.u. of the rating of the finite grid")

    def label(self) -> str:
        return f"grid load {self.change:+g} p.u."


class GridUnbalance(_Event):
    """The grid's phases a, b, c keep a part of their voltage and jump in angle."""

    type: Literal["grid-unbalance"] = Field(description="kind of event")
    retained: tuple[float, float, float] = Field(
        (1.0, 1.0, 1.0), strict=False, description="voltages of a, b, c over what they were"
    )
    degrees: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), strict=False, description="by which a, b, c jump ahead"
    )
    duration: float | None = Field(
        None, gt=0, description="s until they are equal again; none: until another such event"
    )

    @model_validator(mode="after")
    def _in_bounds(self) -> GridUnbalance:
        for name, values, limit in (
            ("retained", self.retained, 1.5),
            ("degrees", self.degrees, 180),
        ):
            low = 0.0 if name == "retained" else -180.0
            if not all(low <= value <= limit for value in values):
                raise ValueError(f"{name} = {list(values)}: must lie in [{low:g}, {limit:g}]")
        return self

    def factors(self) -> tuple[complex, ...]:
        """Of the phase voltages."""
        return tuple(
            size * cmath.exp(1j * math.radians(angle))
            for size, angle in zip(self.retained, self.degrees, strict=True)
        )

    def label(self) -> str:
        sizes = ", ".join(f"{size:g}" for size in self.retained)
        turns = ", ".join(f"{angle:g}°" for angle in self.degrees) if any(self.degrees) else ""
        return f"phases at {sizes}" + (f", turned {turns}" if turns else "")


class Fault(_Event):
    """A fault on a line, or at a node of a network, through ``R`` [p.u.]: three phases or one (LG)
    or two (LLG) to ground, or two to each other (LL)."""

    type: Literal["fault"] = Field(description="kind of event")
    position: float | None = Field(
        None,
        ge=0,
        lt=1,
        description="place on the line: 0 at its start, which for a converter's line is the filter "
        "capacitor, with plant.lcl the point of connection; else 0.001 to 0.999, 1 being its end",
    )
    line: str | None = Field(
        None, description="in a network: name of the line, or of the converter whose line it is"
    )
    node: str | None = Field(None, description="in a network: the node, in place of a position")
    kind: Literal["3ph", "LG", "LL", "LLG"] = Field("3ph", description="which phases it connects")
    phases: str | None = Field(
        None, description="a, b or c (LG); bc, ca or ab (LL, LLG); the first of these if none"
    )
    R: float = Field(
        ge=0,
        le=1e6,
        description="resistance from each phase to ground, of an LL fault between the two, p.u.; "
        "at least 1e-4 at a capacitor",
    )
    X_0: float | None = Field(
        None,
        ge=0,
        le=1e6,
        description="of LG and LLG: reactance to ground for the zero sequence, p.u.; that of the "
        "lines to earthed star points if neither X_0 nor R_0 is given",
    )
    R_0: float | None = Field(
        None, ge=0, le=1e6, description="of LG and LLG: resistance for the zero sequence, p.u."
    )
    duration: float | None = Field(
        None, gt=0, description="s until it is cleared; none: fault-clear clears it"
    )

    @model_validator(mode="after")
    def _has_one_place(self) -> Fault:
        if (self.position is None) == (self.node is None):
            raise ValueError(
                "position, node: give one of them" + (", not both" if self.node else "")
            )
        if self.line is not None and self.position is None:
            raise ValueError(f"line = {self.line!r}: goes with a position")
        return self

    @property
    def Z_0(self) -> complex | None:
        """Impedance for the zero sequence, p.u.; None: that of the lines to star points."""
        if self.X_0 is None and self.R_0 is None:
            return None
        return complex(self.R_0 or 0.0, self.X_0 or 0.0)

    @property
    def what(self) -> str:
        """The kind and the phases, in words."""
        if self.kind == "3ph":
            return "fault"
        return f"{self.kind} fault of {self.phases or FAULTED_PHASES[self.kind][0]}"

    def label(self) -> str:
        line = "the line" if self.line is None else f"line {self.line}"
        where = f"{self.position:g} of {line}" if self.position else f"the start of {line}"
        if self.node is not None:
            where = f"node {self.node}"
        return f"{self.what} at {where}" + (f" for {self.duration:g} s" if self.duration else "")


class FaultClear(_Event):
    """The fault is cleared."""

    type: Literal["fault-clear"] = Field(description="kind of event")

    def label(self) -> str:
        return "fault cleared"


class SynchroCheck(BaseModel):
    """When a breaker may close: its two sides must agree for a time. The defaults are the limits of
    IEEE Std 1547-2018, Table 5, for 1.5 to 10 MVA."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    V: float = Field(0.03, gt=0, le=1, description="largest difference of the voltages, p.u.")
    f_hz: float = Field(0.1, gt=0, le=10, description="of the frequencies, Hz")
    degrees: float = Field(10.0, gt=0, le=180, description="of the angles")
    lasting_s: float = Field(
        0.1, ge=0, le=3600, description="for how long all three must stay within, s"
    )
    within_s: float = Field(
        60.0, gt=0, le=86400, description="after this time the breaker stays open, s"
    )

    @model_validator(mode="after")
    def _has_the_time(self) -> SynchroCheck:
        if self.within_s <= self.lasting_s:
            raise ValueError(
                f"within_s = {self.within_s:g}: must be more than lasting_s = {self.lasting_s:g}"
            )
        return self


_CHECK: Any = Field(
    None, description="closes once both sides agree, by a synchro-check; at once if none"
)


class _Switch(_Event):
    """A breaker."""

    closed: bool = Field(description="false opens it")
    check: SynchroCheck | None = _CHECK

    @model_validator(mode="after")
    def _checks_what_closes(self) -> _Switch:
        if self.check is not None and not self.closed:
            raise ValueError("check: goes with closed = true")
        return self

    def _when(self) -> str:
        return "" if self.check is None else " when synchronous"


class Breaker(_Switch):
    """The grid breaker opens onto the local load, or closes again."""

    type: Literal["grid-breaker"] = Field(description="kind of event")
    closed: bool = Field(description="false opens it onto the local load")

    def label(self) -> str:
        return "grid breaker " + ("closes" if self.closed else "opens") + self._when()


class LineBreaker(_Switch):
    """The breaker of a line or load of a network opens or closes."""

    type: Literal["breaker"] = Field(description="kind of event")
    name: str = Field(
        min_length=1, description="of the line or load, or of the converter whose line it is"
    )

    def label(self) -> str:
        return f"{self.name} " + ("on" if self.closed else "off") + self._when()


Event = Annotated[
    Reference
    | LawChange
    | Gains
    | Reset
    | GridFrequency
    | GridVoltage
    | GridProfile
    | PhaseJump
    | GridImpedance
    | GridLoad
    | GridUnbalance
    | Fault
    | FaultClear
    | Breaker
    | LineBreaker,
    Field(discriminator="type"),
]

CONTROLLER_EVENTS = (Reference, LawChange, Gains, Reset)


def nominal_hz(plant: Network) -> float:
    """Nominal frequency of a plant, Hz."""
    return plant.wiring.omega_b / (2 * math.pi)


def apply_grid_event(event: Any, plant: Network) -> None:
    """Apply one of the plant's events, between two ticks."""
    from gfm_plant import grid

    f_b = nominal_hz(plant)
    match event:
        case GridFrequency():
            rate = event.rate / f_b if event.rate else None
            grid.grid_frequency(plant, event.f_hz / f_b, rate)
        case GridVoltage():
            grid.grid_voltage(plant, event.V_g, event.rate, event.duration)
        case GridProfile():
            raise ValueError("grid-profile: must be in the scenario, which reads it at the start")
        case PhaseJump():
            grid.phase_jump(plant, event.degrees)
        case GridImpedance():
            grid.grid_impedance(plant, *event.factors(plant))
        case GridLoad():
            grid.grid_load(plant, event.change)
        case GridUnbalance():
            grid.grid_unbalance(plant, event.factors(), event.duration)
        case Fault():
            grid.fault(
                plant, event.position, event.R, event.duration, line=event.line, node=event.node,
                kind=event.kind, phases=event.phases, Z_0=event.Z_0,
            )  # fmt: skip
        case FaultClear():
            grid.clear_fault(plant)
        case Breaker() | LineBreaker() if event.check is not None:
            name, by = getattr(event, "name", ""), event.check
            limits = by.V, by.f_hz / f_b, by.degrees, by.lasting_s, by.within_s
            grid.check_synchronism(plant, name, *limits)
        case Breaker():
            grid.breaker(plant, event.closed)
        case LineBreaker():
            grid.line_breaker(plant, event.name, event.closed)
