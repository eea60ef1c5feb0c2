"""The points that clients write, in groups that act together, and the effect of a write.

- Set-points of model 704: a value, its mode, its enable, and the timer that reverts them. One that
  has not been written since it was last disabled reads as the reference in force, so that enabling
  it alone changes nothing. A client may write value, mode and enable in any order and in any number
  of requests; the last of them makes the change. Disabling restores the reference that was in force
  before.
- Stored curves of models 705 and 711: the voltage reference and the droops. Curve (or control) 1
  shows the values in force and cannot be written; the client writes curve 2, which until then reads
  as the one in force. ``Adpt…Req`` = 2 checks curve 2 and adopts it, at once if the function is
  enabled, else when it is enabled. Disabling restores the values that were in force before.
- Heartbeats, start, stop and reset of model 715; law, voltage reference and droops of the vendor
  model, which act at once.

In the steady state of a law with droops (p.u.; Table III)

    omega_u - omega_g = D_p (P_ref - p),        V - V_ref = D_q (Q_ref - q).

A law has D_p if its file names it and phi_22(0) equals it, and H if nothing but p acts on its
omega_u too; it has D_q if its file names it and phi_34(0)/phi_35(0), or its limit, equals it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from gfm_hil.ports.modbus.image import VENDOR, Value
from gfm_hil.ports.modbus.measures import RunState
from gfm_hil.scenario.events.reference import check_reference
from gfm_runtime import LawError, law_file
from gfm_runtime.law import BuiltLaw
from gfm_runtime.lawfile import LawFile, build_law, tied
from gfm_runtime.states import RUNNING

Event = dict[str, Any]
Written = Mapping[str, Value]  # by path

_DROOPS = ("D_p", "D_q")
_NEARLY_DC = 1e-7j  # rad/s; integrators have no value at 0
_SLOW = 1e-3j  # rad/s; far below every time constant of inertia
_RTOL = 1e-3  # printed gains are rounded


@dataclass(frozen=True)
class Droops:
    """D_p and D_q of a law in p.u. and its H in s; None for one that it does not have."""

    D_p: float | None
    D_q: float | None
    H: float | None


def droops(file: LawFile, changed: Mapping[str, float]) -> Droops:
    """The droops of a law with changed parameters; tied parameters follow. Raises LawError: the
    changed law is invalid."""
    law = build_law(file, tied(file, dict(changed)))

    def if_gain_is(gain: complex, name: str) -> float | None:
        """The parameter of that name if the law's gain at rest equals it."""
        value = law.parameters[name].value if name in law.parameters else None
        return None if value is None or abs(gain - value) > _RTOL * abs(value) else value

    phi_22 = law.element("phi", (1, 1))
    D_p = if_gain_is(phi_22(_NEARLY_DC), "D_p")
    # 1/phi_22 = 1/D_p + 2 H s + ..., unless another element acts on omega_u
    only_p = D_p is not None and {c for c in (*law.phi, *law.psi) if c[0] == 1} == {(1, 1)}
    H = max(0.0, (1.0 / phi_22(_SLOW)).imag / (2 * _SLOW.imag)) if only_p else None
    return Droops(D_p, if_gain_is(_reactive_droop(law), "D_q"), H)


def _reactive_droop(law: BuiltLaw) -> complex:
    """phi_34/phi_35 at rest, p.u.; 0 without phi_35."""
    phi_35 = law.element("phi", (2, 4))(_NEARLY_DC)
    return law.element("phi", (2, 3))(_NEARLY_DC) / phi_35 if phi_35 else 0.0


class LawDroops:
    """Droops of the laws that are ready."""

    def __init__(self, laws: Sequence[str]) -> None:
        self._files = {name: law_file(name) for name in laws}
        self._droops = lru_cache(maxsize=64)(
            lambda law, changed: droops(self._files[law], dict(changed))
        )

    def droops(self, law: str, changed: Mapping[str, float]) -> Droops:
        """The droops of a law; ``changed`` holds the parameters that differ from its file."""
        values: Droops = self._droops(law, tuple(changed.items()))
        return values

    def event(self, law: str, changed: Mapping[str, float], wanted: Mapping[str, float]) -> Event:
        """The command that changes a law's droops. Raises ValueError: the law has no droop of that
        name, or the value is invalid."""
        now = self.droops(law, changed)
        for name, value in wanted.items():
            if getattr(now, name) is None:
                raise ValueError(f"{name} = {value:g}: {law} has no {name}")
            if not value > 0:
                raise ValueError(f"{name} = {value:g}: must be > 0")
        try:
            droops(self._files[law], {**changed, **wanted})
        except LawError as problem:
            raise ValueError(str(problem)) from None
        return {"type": "gains", "values": dict(wanted)}


@dataclass(frozen=True)
class Effect:
    """Commands for the run, in order. The device calls ``on_success`` once the run has carried out
    all of them, or ``on_refusal`` if it refused one."""

    events: tuple[Event, ...] = ()
    on_success: Callable[[], None] = lambda: None
    on_refusal: Callable[[], None] = lambda: None


class PointGroup(ABC):
    """Points that clients write together, because only together they say what is wanted."""

    writable: tuple[str, ...]  # paths of the points that clients may write
    layout: Mapping[int, Mapping[str, Any]] = {}  # its own models, as ``Measures.models``

    @abstractmethod
    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        """The effect of writing these values at the device's time ``now``, s, without applying it;
        raises ValueError for invalid values."""

    @abstractmethod
    def show(self, run: RunState, now: float) -> dict[str, Value]:
        """The values of its points by path, in the points' units."""

    def forget(self) -> None:  # noqa: B027
        """Clear the state, if any: the run was reset, or another operator commands it."""


@dataclass(frozen=True)
class Settings:
    """What clients have written; None: not written since the function was last disabled."""

    enabled: bool = False
    mode: int = 0
    # value, percent: the set-point in W or var, and in % of S_n
    value: float | None = None
    percent: float | None = None
    enabled_back: bool = False
    # value_back, percent_back: their values after the timer expires
    value_back: float | None = None
    percent_back: float | None = None
    timeout: int = 0  # s, 0 for none
    until: float | None = None  # the device's time at which the timer expires, s; None: not running
    before: float = 0.0  # the reference in force when it was enabled, p.u.

    def with_value(self, name: str, value: float | None) -> Settings:
        """The same with another value of one field."""
        changes: dict[str, Any] = {name: value}
        return replace(self, **changes)


class SetPoint(PointGroup):
    """P_ref by ``WSet…`` or Q_ref by ``VarSet…`` of model 704.

    Args:
        prefix: ``"WSet"`` or ``"VarSet"``.
        reference: ``"P_ref"`` or ``"Q_ref"``.
        rating: W or var at 1 p.u.
        absolute: the value of ``Mod`` for a set-point in W or var.
        percent: the values of ``Mod`` for a set-point in % of a maximum, which is S_n here.
    """

    def __init__(
        self, prefix: str, reference: str, rating: float, absolute: int, percent: tuple[int, ...]
    ) -> None:
        self._prefix, self.reference, self._rating = f"704.{prefix}", reference, rating
        self._absolute, self._modes = absolute, (*percent, absolute)
        self._keys = {
            f"{self._prefix}{suffix}": key
            for suffix, key in (
                ("Ena", "enabled"), ("Mod", "mode"), ("", "value"), ("Rvrt", "value_back"),
                ("Pct", "percent"), ("PctRvrt", "percent_back"), ("EnaRvrt", "enabled_back"),
                ("RvrtTms", "timeout"),
            )
        }  # fmt: skip
        self.writable = tuple(self._keys)
        self.settings = Settings(mode=absolute)

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        changes: dict[str, Any] = {self._keys[path]: value for path, value in written.items()}
        new = replace(self.settings, **changes)
        if new.mode not in self._modes:
            raise ValueError(f"{self._prefix}Mod = {new.mode:g}: must be one of {self._modes}")
        for name in ("value", "value_back", "percent", "percent_back"):
            number = getattr(new, name)
            if number is not None:
                check_reference(self.reference, number / self._unit(name))
        new = replace(new, enabled=bool(new.enabled), enabled_back=bool(new.enabled_back))
        return self._plan(new, run, now, changed=True)

    def end(self, now: float) -> None:
        """If enabled, make the timer expire at ``now``, even if none runs."""
        if self.settings.enabled:
            self.settings = replace(self.settings, until=now)

    def expired(self, now: float) -> bool:
        """Whether the timer has expired at ``now``, s."""
        return self.settings.until is not None and now >= self.settings.until

    def revert(self, run: RunState, now: float) -> Effect:
        """The effect of the timer's expiry: the set-point and enable of ``…Rvrt``."""
        s = self.settings
        name = self._in_force(s)
        back = getattr(s, f"{name}_back")
        new = s.with_value(name, s.before * self._unit(name) if back is None else back)
        return self._plan(replace(new, enabled=s.enabled_back), run, now, changed=False)

    def forget(self) -> None:
        self.settings = Settings(mode=self._absolute)

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        s, in_force = self.settings, run.references[self.reference]
        back = s.before if s.enabled else in_force
        values: dict[str, Value] = {}
        for path, key in self._keys.items():
            value = getattr(s, key)
            if value is None:
                value = (back if key.endswith("_back") else in_force) * self._unit(key)
            values[path] = float(value)
        left = 0.0 if s.until is None else max(s.until - now, 0.0)
        values[f"{self._prefix}RvrtRem"] = float(math.ceil(left))
        return values

    def _plan(self, new: Settings, run: RunState, now: float, changed: bool) -> Effect:
        old = self.settings
        target: float | None = None
        if new.enabled:
            if not old.enabled:
                new = replace(new, before=run.references[self.reference])
            if new.mode != old.mode:  # do not keep the old mode's value
                left = self._in_force(old)
                if getattr(new, left) == getattr(old, left):
                    new = new.with_value(left, None)
            name = self._in_force(new)
            number = getattr(new, name)
            target = None if number is None else number / self._unit(name)
        elif old.enabled:
            target = old.before
            new = replace(new, value=None, percent=None)
        running = changed and new.enabled and new.timeout > 0
        new = replace(new, until=now + new.timeout if running else None)

        def store() -> None:
            self.settings = new

        return Effect(() if target is None else (_reference(self.reference, target),), store)

    def _in_force(self, s: Settings) -> str:
        return "value" if s.mode == self._absolute else "percent"

    def _unit(self, name: str) -> float:
        """1 p.u. in the unit of a setting."""
        return self._rating if name.startswith("value") else 100.0


def _reference(name: str, value: float) -> Event:
    return {"type": "reference", name: value}


COMPLETED, FAILED = 1, 2
_SPAN = 100.0  # %: the two points that show the droop in force have Var = ± this
_RESOLUTION = 0.015  # %: largest deviation of the line from the reference
_WRITABLE = 2  # number of the curve that a client may write

#: what a curve stands for: "V_ref", "D_p", "D_q", p.u.
DroopValues = dict[str, float]


@dataclass(frozen=True)
class CurveState:
    """State of a function with stored curves."""

    enabled: bool = False
    request: int = 1
    result: int = COMPLETED
    values: DroopValues | None = None  # those adopted; disabling clears it
    before: DroopValues | None = None  # in force when it was enabled, under the law below
    law: str = ""


class Curves(PointGroup):
    """A function with stored curves: what models 705 and 711 have in common."""

    # model, curve: the model's number and its name of a curve
    model: int
    curve: str
    stored: tuple[str, ...]  # paths within the curve of the points that a client may write

    def __init__(self, gains: LawDroops) -> None:
        self._gains = gains
        self._enable, adopt = f"{self.model}.Ena", f"{self.model}.Adpt{self.curve}"
        self._request, self._result = f"{adopt}Req", f"{adopt}Rslt"
        self._fixed, self._own = (f"{self.model}.{self.curve}{k}." for k in (1, _WRITABLE))
        own = (self._own + name for name in self.stored)
        self.writable = (self._enable, self._request, *own)
        self.state = CurveState()
        self._stored: dict[str, Value] = {}

    @abstractmethod
    def read(self, stored: Written) -> DroopValues:
        """V_ref and droops, by name, of stored points; raises ValueError if these are invalid."""

    @abstractmethod
    def write(self, values: DroopValues) -> dict[str, Value]:
        """The stored points that show V_ref and droops."""

    @abstractmethod
    def in_force(self, run: RunState) -> DroopValues:
        """V_ref and droops now in force."""

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        own = {p.removeprefix(self._own): v for p, v in written.items() if p.startswith(self._own)}
        stored = self._stored | own
        new = old = self.state
        events: tuple[Event, ...] = ()
        adopts = self._request in written

        def fail() -> None:
            if adopts:
                self.state = replace(old, result=FAILED)

        if adopts:
            if written[self._request] != _WRITABLE:
                raise ValueError(
                    f"{self._request}: must be {_WRITABLE}, the one that can be written"
                )
            try:
                values = self.read(self.write(self.in_force(run)) | stored)
                self._events(values, run)
            except ValueError:
                fail()
                raise
            new = replace(new, request=_WRITABLE, result=COMPLETED, values=values)
        if self._enable in written:
            new = replace(new, enabled=bool(written[self._enable]))
        if new.enabled and not old.enabled:
            new = replace(new, before=self.in_force(run), law=run.law)
        if new.enabled and new.values and (adopts or not old.enabled):
            events = self._events(new.values, run)
        elif old.enabled and not new.enabled:
            before = old.before or {}
            if run.law != old.law:  # the droops were those of another law
                before = {name: value for name, value in before.items() if name == "V_ref"}
            events = self._events(before, run) if old.values else ()
            new = replace(new, values=None, before=None)

        def store() -> None:
            self.state, self._stored = new, stored

        return Effect(events, store, fail)

    def forget(self) -> None:
        self.state, self._stored = CurveState(), {}

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        s, now_in_force = self.state, self.write(self.in_force(run))
        return {
            self._enable: float(s.enabled),
            self._request: float(s.request),
            self._result: float(s.result),
            **{self._fixed + n: v for n, v in now_in_force.items()},
            **{self._own + n: v for n, v in (now_in_force | self._stored).items()},
        }

    def _events(self, values: DroopValues, run: RunState) -> tuple[Event, ...]:
        """The commands for V_ref and droops; droops first, since the run may refuse them."""
        events = []
        droops = {name: value for name, value in values.items() if name != "V_ref"}
        if droops:
            events.append(self._gains.event(run.law, run.gains, droops))
        if "V_ref" in values:
            events.append(_reference("V_ref", values["V_ref"]))
        return tuple(events)


class VoltVar(Curves):
    """Model 705: V_ref and D_q.

    Two points (V_a, Var_a), (V_b, Var_b) in % of V_n and S_n lie on the line of the law's droop,
    with V relative to ``VRef`` and Var to the reactive set-point: V - 100 % = -D_q Var, so that
    D_q = (V_a - V_b)/(Var_b - Var_a). ``ActPt`` = 0: V_ref alone.
    """

    model, curve = 705, "Crv"
    stored = ("ActPt", "VRef", "Pt1.V", "Pt1.Var", "Pt2.V", "Pt2.Var")

    def in_force(self, run: RunState) -> DroopValues:
        D_q = self._gains.droops(run.law, run.gains).D_q
        return {"V_ref": run.references["V_ref"], **({} if D_q is None else {"D_q": D_q})}

    def read(self, stored: Written) -> DroopValues:
        v_ref = _number(stored, "VRef") / 100.0
        check_reference("V_ref", v_ref)
        count = _number(stored, "ActPt")
        if count == 0:
            return {"V_ref": v_ref}
        if count != 2:
            raise ValueError(f"705: ActPt = {count:g}: must be 2, or 0 for VRef alone")
        (v_a, var_a), (v_b, var_b) = (
            (_number(stored, f"Pt{k}.V") - 100.0, _number(stored, f"Pt{k}.Var")) for k in (1, 2)
        )
        if var_a <= var_b or v_a >= v_b:
            raise ValueError("705: V must rise and Var must fall from point 1 to point 2")
        D_q = (v_b - v_a) / (var_a - var_b)
        if abs(v_a + D_q * var_a) > _RESOLUTION:
            raise ValueError("705: the line must pass through V = 100 %, Var = 0")
        return {"V_ref": v_ref, "D_q": D_q}

    def write(self, values: DroopValues) -> dict[str, Value]:
        D_q = values.get("D_q")
        points: dict[str, Value] = {}
        for k, var in ((1, _SPAN), (2, -_SPAN)):
            points[f"Pt{k}.V"] = None if D_q is None else 100.0 - D_q * var
            points[f"Pt{k}.Var"] = None if D_q is None else var
        active = 0.0 if D_q is None else 2.0
        return {"ActPt": active, "VRef": 100.0 * values["V_ref"], **points}


class Droop(Curves):
    """Model 711: D_p = ``KOf`` = ``KUf``, no dead band."""

    model, curve = 711, "Ctl"
    stored = ("DbOf", "DbUf", "KOf", "KUf", "RspTms")

    def in_force(self, run: RunState) -> DroopValues:
        D_p = self._gains.droops(run.law, run.gains).D_p
        return {} if D_p is None else {"D_p": D_p}

    def read(self, stored: Written) -> DroopValues:
        over, under = _number(stored, "KOf"), _number(stored, "KUf")
        if over != under:
            raise ValueError(f"711: KOf = {over:g}, KUf = {under:g}: must be equal")
        for name in ("DbOf", "DbUf", "RspTms"):
            if _number(stored, name) != 0:
                raise ValueError(f"711: {name} = {_number(stored, name):g}: must be 0")
        return {"D_p": over}

    def write(self, values: DroopValues) -> dict[str, Value]:
        D_p = values.get("D_p")
        return {"DbOf": 0.0, "DbUf": 0.0, "KOf": D_p, "KUf": D_p, "RspTms": 0.0}


def _number(stored: Written, name: str) -> float:
    value = stored[name]
    if not isinstance(value, (int, float)):
        raise ValueError(f"{name}: has no value")
    return float(value)


STOP, START = 0, 1  # of OpCtl
_SHORTEST_MS, _LONGEST_MS = 100, 3_600_000  # of HbTms


class Heartbeat(PointGroup):
    """The client's heartbeat: once a client has written it, it must keep changing, and stay the
    same for no longer than ``timeout_ms``; 0: for ever."""

    writable = ("715.ControllerHb", f"{VENDOR}.HbTms")

    def __init__(self, timeout_ms: int) -> None:
        self._value: float | None = None
        self._timeout_ms = timeout_ms
        self._lost = 0
        self._late: float | None = None  # ms
        self._last: float | None = None  # the device's time of the last beat, s; None: lost
        self.missing = False

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        timeout, value = written.get(f"{VENDOR}.HbTms"), written.get("715.ControllerHb")
        if timeout and not _SHORTEST_MS <= float(timeout) <= _LONGEST_MS:
            raise ValueError(
                f"HbTms = {timeout}: must lie in [{_SHORTEST_MS}, {_LONGEST_MS}] ms, or be 0"
            )

        def store() -> None:
            if isinstance(timeout, (int, float)):
                self._timeout_ms = int(timeout)
            if isinstance(value, (int, float)) and value != self._value:
                self._value, self._last, self.missing = value, now, False

        return Effect(on_success=store)

    def lost(self, now: float) -> bool:
        """Whether it is lost since the last call, at ``now``, s; true once per loss."""
        if self._last is None or not self._timeout_ms:
            return False
        waited_ms = (now - self._last) * 1e3
        if waited_ms < self._timeout_ms:
            return False
        self._last, self._lost, self._late, self.missing = None, self._lost + 1, waited_ms, True
        return True

    def forget(self) -> None:
        """Expect no heartbeat until a client writes it again."""
        self._last, self.missing = None, False

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        return {
            "715.ControllerHb": self._value or 0.0,
            f"{VENDOR}.HbTms": float(self._timeout_ms),
            f"{VENDOR}.HbLost": float(self._lost),
            f"{VENDOR}.HbLate": self._late,
        }


class Operation(PointGroup):
    """OpCtl and AlarmReset."""

    writable = ("715.AlarmReset", "715.OpCtl")

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        reset, control = written.get("715.AlarmReset", 0), written.get("715.OpCtl")
        if reset not in (0, 1):
            raise ValueError(f"AlarmReset = {reset}: must be 1, to reset")
        if control not in (None, STOP, START):
            raise ValueError(f"OpCtl = {control}: must be {STOP} (STOP) or {START} (START)")
        if control == STOP:
            if reset:
                raise ValueError("AlarmReset = 1, OpCtl = 0: one or the other")
            return Effect(({"type": "stop"},))
        if (reset or control == START) and run.safe:
            return Effect(({"type": "reset"},))
        return Effect()

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        running = run.state == RUNNING and not run.safe
        return {"715.AlarmReset": 0.0, "715.OpCtl": float(START if running else STOP)}


class Direct(PointGroup):
    """Points that act at once: by path, the name of a reference or a droop, and its 1 p.u. in the
    point's unit."""

    def __init__(self, gains: LawDroops, points: Mapping[str, tuple[str, float]]) -> None:
        self._gains, self._points, self.writable = gains, points, tuple(points)

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        events: list[Event] = []
        wanted: dict[str, float] = {}
        for path in written:
            name, unit = self._points[path]
            value = _number(written, path) / unit
            if name in _DROOPS:
                wanted[name] = value
            else:
                check_reference(name, value)
                events.append(_reference(name, value))
        if wanted:
            events.append(self._gains.event(run.law, run.gains, wanted))
        return Effect(tuple(events))

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        in_force = run.references | vars(self._gains.droops(run.law, run.gains))
        return {
            path: None if in_force[name] is None else in_force[name] * unit
            for path, (name, unit) in self._points.items()
        }


class ActiveLaw(PointGroup):
    """The law, as its number in the vendor model's list."""

    writable = (f"{VENDOR}.Law",)

    def __init__(self, laws: Sequence[str]) -> None:
        self._laws = laws

    def plan(self, written: Written, run: RunState, now: float) -> Effect:
        number = _number(written, f"{VENDOR}.Law")
        if not 1 <= number <= len(self._laws):
            raise ValueError(f"Law = {number:g}: must lie in [1, {len(self._laws)}]")
        return Effect(({"type": "law", "law": self._laws[int(number) - 1]},))

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        return {f"{VENDOR}.Law": float(self._laws.index(run.law) + 1)}
