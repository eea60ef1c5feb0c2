"""Model 715 and the vendor model's own points: heartbeats, start, stop, reset, law and gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gfm_hil.ports.modbus.droops import LawDroops
from gfm_hil.ports.modbus.image import VENDOR, Value
from gfm_hil.ports.modbus.run_state import RunState
from gfm_hil.ports.modbus.writes import Effect, PointGroup
from gfm_hil.scenario.events.reference import check_reference
from gfm_runtime.states import RUNNING

STOP, START = 0, 1  # of OpCtl
_SHORTEST_MS, _LONGEST_MS = 100, 3_600_000  # of HbTms


class Heartbeat:
    """The client's heartbeat: once a client has written it, it must keep changing.

    Args:
        timeout_ms: how long it may stay the same; 0: for ever.
    """

    def __init__(self, timeout_ms: int) -> None:
        self.writable = ("715.ControllerHb", f"{VENDOR}.HbTms")
        self._value: float | None = None
        self._timeout_ms = timeout_ms
        self._last: float | None = None  # the device's time of the last beat, s; None: lost
        self._lost = 0
        self._late: float | None = None  # ms
        self.missing = False

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
        timeout, value = written.get(f"{VENDOR}.HbTms"), written.get("715.ControllerHb")
        if timeout and not _SHORTEST_MS <= float(timeout) <= _LONGEST_MS:
            raise ValueError(
                f"HbTms = {timeout}: must lie in [{_SHORTEST_MS}, {_LONGEST_MS}] ms, or be 0"
            )

        def keep() -> None:
            if isinstance(timeout, (int, float)):
                self._timeout_ms = int(timeout)
            if isinstance(value, (int, float)) and value != self._value:
                self._value, self._last, self.missing = value, now, False

        return Effect(keep=keep)

    def expire(self, now: float) -> bool:
        """Whether it has just been lost; true once per loss."""
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

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
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
    """The vendor model's points that act at once: law, voltage reference and droops."""

    writable = tuple(f"{VENDOR}.{name}" for name in ("Law", "VRef", "Dp", "Dq"))

    def __init__(self, laws: Sequence[str], gains: LawDroops) -> None:
        self._laws, self._gains = laws, gains

    def plan(self, written: Mapping[str, Value], run: RunState, now: float) -> Effect:
        given = {
            path.partition(".")[2]: float(value)
            for path, value in written.items()
            if isinstance(value, (int, float))
        }
        events: list[dict[str, Any]] = []
        if "Law" in given:
            if not 1 <= given["Law"] <= len(self._laws):
                raise ValueError(f"Law = {given['Law']:g}: must lie in [1, {len(self._laws)}]")
            events.append({"type": "law", "law": self._laws[int(given["Law"]) - 1]})
        if "VRef" in given:
            check_reference("V_ref", given["VRef"])
            events.append({"type": "reference", "V_ref": given["VRef"]})
        wanted = {name: given[key] for key, name in (("Dp", "D_p"), ("Dq", "D_q")) if key in given}
        if wanted:
            events.append(self._gains.event(run.law, run.gains, wanted))
        return Effect(tuple(events))

    def show(self, run: RunState, now: float) -> dict[str, Value]:
        droops = self._gains.droops(run.law, run.gains)
        return {
            f"{VENDOR}.Law": float(self._laws.index(run.law) + 1),
            f"{VENDOR}.VRef": run.references["V_ref"],
            f"{VENDOR}.Dp": droops.D_p,
            f"{VENDOR}.Dq": droops.D_q,
        }
