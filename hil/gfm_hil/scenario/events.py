"""The events of a scenario, one pydantic model per kind.

An event has a time ``t`` [s] or a ``tick``. The controller carries out references and law changes,
the plant all events of the grid; each side selects its own.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from gfm_runtime.signals import SIGNALS

_REFERENCE = {s.name: s for s in SIGNALS if s.group == "ref"}


class _Event(BaseModel):
    """The time of an event; each kind adds its fields and a short ``label`` for figures and
    reports."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    t: float | None = Field(None, ge=0, le=86400, description="s")
    tick: int | None = Field(None, ge=0, le=86_400_000_000)  # 86400 s of 1 us

    @model_validator(mode="after")
    def _one_time(self) -> _Event:
        if (self.t is None) == (self.tick is None):
            raise ValueError(f"t = {self.t}, tick = {self.tick}: give one of them")
        return self

    def at(self, T_s: float) -> int:
        """The tick of the event; a time is rounded to the nearest tick."""
        return self.tick if self.tick is not None else round((self.t or 0.0) / T_s)


class Reference(_Event):
    """New references; ``ramp_s`` spreads the change over a time instead of one tick."""

    type: Literal["reference"]
    V_dcref: float | None = None
    P_ref: float | None = None
    omega_g: float | None = None
    Q_ref: float | None = None
    V_ref: float | None = None
    ramp_s: float = Field(0.0, ge=0)

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

    type: Literal["law"]
    law: str

    def label(self) -> str:
        return f"law {self.law}"


class Gains(_Event):
    """New gains of the active law, by the names in its file, without a bump. Tied parameters
    follow."""

    type: Literal["gains"]
    values: dict[str, float] = Field(min_length=1)

    def label(self) -> str:
        return ", ".join(f"{name} = {value:g}" for name, value in self.values.items())


class Reset(_Event):
    """Return from a trip or the safe state to the scenario's start, for runs that wait there."""

    type: Literal["reset"]

    def label(self) -> str:
        return "reset"


class GridFrequency(_Event):
    """Grid frequency: a step, or a ramp at ``rate`` [Hz/s]."""

    type: Literal["grid-frequency"]
    f_hz: float = Field(gt=0, le=1000)
    rate: float | None = Field(None, gt=0)

    def label(self) -> str:
        return f"grid {self.f_hz:g} Hz" + (f" at {self.rate:g} Hz/s" if self.rate else "")


class GridVoltage(_Event):
    """Grid voltage [p.u.]: a step, a ramp at ``rate`` [p.u./s], or a sag of ``duration`` [s]."""

    type: Literal["grid-voltage"]
    V_g: float = Field(ge=0, le=1.5)
    rate: float | None = Field(None, gt=0)
    duration: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _ramp_or_sag(self) -> GridVoltage:
        if self.rate is not None and self.duration is not None:
            raise ValueError(f"rate = {self.rate}, duration = {self.duration}: a ramp or a sag")
        return self

    def label(self) -> str:
        return f"grid {self.V_g:g} p.u." + (f" for {self.duration:g} s" if self.duration else "")


class PhaseJump(_Event):
    """The grid's angle jumps ahead by ``degrees``."""

    type: Literal["grid-phase-jump"]
    degrees: float = Field(ge=-180, le=180)

    def label(self) -> str:
        return f"phase jump {self.degrees:g}°"


class GridImpedance(_Event):
    """The line becomes ``L_g`` and ``R_g`` times its nominal elements."""

    type: Literal["grid-impedance"]
    L_g: float = Field(gt=0, le=1e12)
    R_g: float = Field(ge=0, le=1e12)

    def label(self) -> str:
        return f"line L × {self.L_g:g}, R × {self.R_g:g}"


class Breaker(_Event):
    """The grid breaker opens onto the local load, or closes again."""

    type: Literal["grid-breaker"]
    closed: bool

    def label(self) -> str:
        return "grid breaker " + ("closes" if self.closed else "opens")


Event = Annotated[
    Reference
    | LawChange
    | Gains
    | Reset
    | GridFrequency
    | GridVoltage
    | PhaseJump
    | GridImpedance
    | Breaker,
    Field(discriminator="type"),
]

CONTROLLER_EVENTS = (Reference, LawChange, Gains, Reset)


def apply_grid_event(event: Any, par: Any, st: Any) -> None:
    """Apply one of the plant's events to its records, between two ticks."""
    from gfm_plant import breaker, grid_frequency, grid_impedance, grid_voltage, phase_jump

    f_b = float(par[0]["omega_b"]) / (2 * math.pi)
    match event:
        case GridFrequency():
            rate = event.rate / f_b if event.rate else None
            grid_frequency(st, event.f_hz / f_b, rate)
        case GridVoltage():
            grid_voltage(st, event.V_g, event.rate, event.duration)
        case PhaseJump():
            phase_jump(st, event.degrees)
        case GridImpedance():
            grid_impedance(par, st, event.L_g, event.R_g)
        case Breaker():
            breaker(par, st, event.closed)
