"""Models 705 and 711: the voltage reference and the droops, as SunSpec's stored curves.

Curve (or control) 1 shows the values in force and cannot be written; the client writes curve 2.
``Adpt…Req`` = 2 checks curve 2 and adopts it, at once if the function is enabled, else when it is
enabled. Disabling restores the values that were in force before.

A curve that has not been written reads as the one in force.

- 705: two points (V_a, Var_a), (V_b, Var_b) in % of V_n and S_n on the line of the law's droop,
  with V relative to ``VRef`` and Var to the reactive set-point:
  V - 100 % = -D_q Var, so that D_q = (V_a - V_b)/(Var_b - Var_a). ``ActPt`` = 0: V_ref alone.
- 711: ``KOf`` = ``KUf`` = D_p, no dead band.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from gfm_hil.ports.modbus.droops import LawDroops
from gfm_hil.ports.modbus.image import Value
from gfm_hil.ports.modbus.run_state import RunState
from gfm_hil.ports.modbus.writes import Effect
from gfm_hil.scenario.events.reference import check_reference

COMPLETED, FAILED = 1, 2
_SPAN = 100.0  # %: the two points that show the droop in force have Var = ± this
_RESOLUTION = 0.015  # %: largest deviation of the line from the reference
_MINE = 2  # the curve that a client may write

#: meaning of a curve: "V_ref" [p.u.], "D_p", "D_q"
Meaning = dict[str, float]


@dataclass(frozen=True)
class Adopted:
    """State of a function with stored curves."""

    enabled: bool = False
    request: int = 1
    result: int = COMPLETED
    meaning: Meaning | None = None  # adopted; disabling clears it
    before: Meaning | None = None  # in force when it was enabled, under the law below
    law: str = ""


class Curves(ABC):
    """What both models share.

    Attributes:
        model, curve: the model's number and its name of a curve.
        stored: paths within the curve of the points that a client may write.
    """

    model: int
    curve: str
    stored: tuple[str, ...]

    def __init__(self, gains: LawDroops) -> None:
        self._gains = gains
        self._head, self._adopt = str(self.model), f"{self.model}.Adpt{self.curve}"
        self._curve = f"{self.model}.{self.curve}"
        self._stored: dict[str, Value] = {}
        own = tuple(f"{self._curve}{_MINE}.{name}" for name in self.stored)
        self.writable = (f"{self._head}.Ena", f"{self._adopt}Req", *own)
        self.state = Adopted()

    @abstractmethod
    def read(self, stored: Mapping[str, Value]) -> Meaning:
        """The meaning of stored values; raises ValueError if they are invalid."""

    @abstractmethod
    def write(self, meaning: Meaning) -> dict[str, Value]:
        """The stored values of a meaning."""

    @abstractmethod
    def in_force(self, run: RunState) -> Meaning:
        """The meaning now in force."""

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
        prefix = f"{self._curve}{_MINE}."
        stored = {p.removeprefix(prefix): v for p, v in written.items() if p.startswith(prefix)}
        stored = {**self._stored, **stored}
        whole = {**self.write(self.in_force(run)), **stored}
        new = old = self.state
        events: tuple[dict[str, Any], ...] = ()

        def fail() -> None:
            if f"{self._adopt}Req" in written:
                self.state = replace(old, result=FAILED)

        adopts = f"{self._adopt}Req" in written
        if adopts:
            if written[f"{self._adopt}Req"] != _MINE:
                raise ValueError(f"{self._adopt}Req: must be {_MINE}, the one that can be written")
            try:
                meaning = self.read(whole)
                self._events(meaning, run)
            except ValueError:
                fail()
                raise
            new = replace(new, request=_MINE, result=COMPLETED, meaning=meaning)
        if f"{self._head}.Ena" in written:
            new = replace(new, enabled=bool(written[f"{self._head}.Ena"]))
        if new.enabled and not old.enabled:
            new = replace(new, before=self.in_force(run), law=run.law)
        if new.enabled and new.meaning and (adopts or not old.enabled):
            events = self._events(new.meaning, run)
        elif old.enabled and not new.enabled:
            events = self._events(self._back(old, run), run) if old.meaning else ()
            new = replace(new, meaning=None, before=None)

        def keep() -> None:
            self.state, self._stored = new, stored

        return Effect(events, keep, fail)

    def forget(self) -> None:
        self.state, self._stored = Adopted(), {}

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        s, there = self.state, self.write(self.in_force(run))
        return {
            f"{self._head}.Ena": float(s.enabled),
            f"{self._adopt}Req": float(s.request),
            f"{self._adopt}Rslt": float(s.result),
            **{f"{self._curve}1.{n}": v for n, v in there.items()},
            **{f"{self._curve}{_MINE}.{n}": v for n, v in {**there, **self._stored}.items()},
        }

    def _back(self, s: Adopted, run: RunState) -> Meaning:
        """The values in force before; if the law has changed since, it keeps its own droops."""
        before = s.before or {}
        if run.law == s.law:
            return before
        return {name: value for name, value in before.items() if name == "V_ref"}

    def _events(self, meaning: Meaning, run: RunState) -> tuple[dict[str, Any], ...]:
        """The commands for a meaning; gains first, since the run may refuse them."""
        events: list[dict[str, Any]] = []
        droops = {name: value for name, value in meaning.items() if name != "V_ref"}
        if droops:
            events.append(self._gains.event(run.law, run.gains, droops))
        if "V_ref" in meaning:
            events.append({"type": "reference", "V_ref": meaning["V_ref"]})
        return tuple(events)


class VoltVar(Curves):
    """Model 705: V_ref and D_q."""

    model, curve = 705, "Crv"
    stored = ("ActPt", "VRef", "Pt1.V", "Pt1.Var", "Pt2.V", "Pt2.Var")

    def in_force(self, run: RunState) -> Meaning:
        D_q = self._gains.droops(run.law, run.gains).D_q
        return {"V_ref": run.references["V_ref"], **({} if D_q is None else {"D_q": D_q})}

    def read(self, stored: Mapping[str, Value]) -> Meaning:
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

    def write(self, meaning: Meaning) -> dict[str, Value]:
        D_q = meaning.get("D_q")
        points: dict[str, Value] = {}
        for k, var in ((1, _SPAN), (2, -_SPAN)):
            points[f"Pt{k}.V"] = None if D_q is None else 100.0 - D_q * var
            points[f"Pt{k}.Var"] = None if D_q is None else var
        active = 0.0 if D_q is None else 2.0
        return {"ActPt": active, "VRef": 100.0 * meaning["V_ref"], **points}


class Droop(Curves):
    """Model 711: D_p."""

    model, curve = 711, "Ctl"
    stored = ("DbOf", "DbUf", "KOf", "KUf", "RspTms")

    def in_force(self, run: RunState) -> Meaning:
        D_p = self._gains.droops(run.law, run.gains).D_p
        return {} if D_p is None else {"D_p": D_p}

    def read(self, stored: Mapping[str, Value]) -> Meaning:
        over, under = _number(stored, "KOf"), _number(stored, "KUf")
        if over != under:
            raise ValueError(f"711: KOf = {over:g}, KUf = {under:g}: must be equal")
        for name in ("DbOf", "DbUf", "RspTms"):
            if _number(stored, name) != 0:
                raise ValueError(f"711: {name} = {_number(stored, name):g}: must be 0")
        return {"D_p": over}

    def write(self, meaning: Meaning) -> dict[str, Value]:
        D_p = meaning.get("D_p")
        return {"DbOf": 0.0, "DbUf": 0.0, "KOf": D_p, "KUf": D_p, "RspTms": 0.0}


def _number(stored: Mapping[str, Value], name: str) -> float:
    value = stored[name]
    if not isinstance(value, (int, float)):
        raise ValueError(f"{name}: not given")
    return float(value)
