"""Set-points of model 704: a value, its mode, its enable, and the timer that reverts them.

A set-point that has not been written since it was last disabled reads as the reference in force,
so that enabling it alone changes nothing. A client may write value, mode and enable in any order
and in any number of requests; the last of them makes the change. Disabling restores the reference
that was in force before.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from gfm_hil.ports.modbus.image import Value
from gfm_hil.ports.modbus.run_state import RunState
from gfm_hil.ports.modbus.writes import Effect
from gfm_hil.scenario.events.reference import check_reference


@dataclass(frozen=True)
class Settings:
    """What clients have written; None: not written since the function was last disabled.

    Attributes:
        value, percent: the set-point in W or var, and in % of S_n.
        value_back, percent_back: their values after the timer expires.
        timeout: s, 0 for none.
        until: the device's time at which the timer expires, s; None: not running.
        before: the reference in force when it was enabled, p.u.
    """

    enabled: bool = False
    mode: int = 0
    value: float | None = None
    percent: float | None = None
    enabled_back: bool = False
    value_back: float | None = None
    percent_back: float | None = None
    timeout: int = 0
    until: float | None = None
    before: float = 0.0


class SetPoint:
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

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
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
        """If enabled, let the timer expire now, even if none is running."""
        if self.settings.enabled:
            self.settings = replace(self.settings, until=now)

    def expire(self, now: float) -> bool:
        """Whether the timer has expired."""
        return self.settings.until is not None and now >= self.settings.until

    def revert(self, run: RunState, now: float) -> Effect:
        """The effect of the timer's expiry: the set-point and enable of ``…Rvrt``."""
        s = self.settings
        name = self._in_force(s)
        new = replace(_with(s, name, self._back(s, name)), enabled=s.enabled_back)
        return self._plan(new, run, now, changed=False)

    def forget(self) -> None:
        """Clear the state after a reset: the run is back at its start, without commands."""
        self.settings = Settings(mode=self._absolute)

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        s = self.settings
        there = run.references[self.reference]
        back = s.before if s.enabled else there
        found: dict[str, Value] = {}
        for path, key in self._keys.items():
            value = getattr(s, key)
            if value is None:
                value = (back if key.endswith("_back") else there) * self._unit(key)
            found[path] = float(value)
        left = 0.0 if s.until is None else max(s.until - now, 0.0)
        found[f"{self._prefix}RvrtRem"] = -(-left // 1)
        return found

    def _plan(self, new: Settings, run: RunState, now: float, changed: bool) -> Effect:
        old = self.settings
        target: float | None = None
        if new.enabled:
            if not old.enabled:
                new = replace(new, before=run.references[self.reference])
            if new.mode != old.mode:  # do not keep the old mode's value
                left = self._in_force(old)
                if getattr(new, left) == getattr(old, left):
                    new = _with(new, left, None)
            name = self._in_force(new)
            number = getattr(new, name)
            target = None if number is None else number / self._unit(name)
        elif old.enabled:
            target = old.before
            new = replace(new, value=None, percent=None)
        running = changed and new.enabled and new.timeout > 0
        new = replace(new, until=now + new.timeout if running else None)

        def keep() -> None:
            self.settings = new

        if target is None:
            return Effect(keep=keep)
        return Effect(({"type": "reference", self.reference: target},), keep)

    def _in_force(self, s: Settings) -> str:
        return "value" if s.mode == self._absolute else "percent"

    def _unit(self, name: str) -> float:
        """1 p.u. in the unit of a setting."""
        return self._rating if name.startswith("value") else 100.0

    def _back(self, s: Settings, name: str) -> float | None:
        value = getattr(s, f"{name}_back")
        return s.before * self._unit(name) if value is None else value


def _with(s: Settings, name: str, value: float | None) -> Settings:
    changes: dict[str, Any] = {name: value}
    return replace(s, **changes)
