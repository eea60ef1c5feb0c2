"""The present state of a run, as the device needs it: read from the recording, not in the loop."""

from __future__ import annotations

import contextlib
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_hil.recording.live import LiveRun
from gfm_hil.recording.timing import SLACK
from gfm_hil.scenario import Scenario
from gfm_runtime.states import SAFE

_NAMES_S = 0.1  # how old names and gains may be
_WINDOW_S = 1.0  # window of the slack


@dataclass(frozen=True)
class Slack:
    """Time left when u[k] arrived at the plant before tick k + 1, µs; NaN without deadlines."""

    p50: float = math.nan
    p1: float = math.nan
    p01: float = math.nan
    least: float = math.nan


@dataclass(frozen=True)
class RunState:
    """The state of a run at one tick.

    Attributes:
        row: every column of the recording at the newest tick, by name.
        tick, misses: of the plant, since the start.
        state: of the controller, index into ``gfm_runtime.controller.STATES``.
        law: name of the active law.
        gains: its parameters that differ from its file.
        reason: why the controller is in SAFE or the plant tripped, or "".
    """

    row: dict[str, float]
    tick: int
    misses: int
    state: int
    law: str
    gains: dict[str, float]
    reason: str

    @property
    def safe(self) -> bool:
        """Whether the bridge is blocked: a trip, or the controller's safe state."""
        return self.state == SAFE or self.row["true_trip"] != 0.0

    @property
    def references(self) -> dict[str, float]:
        """The references in force by name, p.u."""
        return {k.removeprefix("ref_"): v for k, v in self.row.items() if k.startswith("ref_")}


class Watcher:
    """Observes a run in progress without load on its loops."""

    def __init__(self, operator: Operator, folder: Path, scenario: Scenario) -> None:
        self._operator, self._run = operator, LiveRun(folder)
        self._T_s = scenario.T_s
        self._window = max(round(_WINDOW_S / scenario.T_s), 1)
        self._said: dict[str, Any] = {}
        self._code: tuple[float, ...] = ()
        self._asked = -math.inf

    def look(self) -> RunState | None:
        """The newest tick of both sides, or None before there is one."""
        plant, controller = self._run.done("plant"), self._run.done("controller")
        if not (plant and controller):
            return None
        row = self._run.row("plant", plant - 1) | self._run.row("controller", controller - 1)
        code = (row["law"], row["state"], row["true_trip"])
        now = time.monotonic()
        if code != self._code or now >= self._asked + _NAMES_S:  # reading files takes time
            with contextlib.suppress(UserError):  # slightly old names will do
                self._said = {**self._said, **self._operator.snapshot()}
            self._code, self._asked = code, now
        if "active" not in self._said:  # the controller's command server is not open yet
            return None
        return RunState(
            row=row,
            tick=plant - 1,
            misses=self._run.misses,
            state=int(row["state"]),
            law=self._said["active"],
            gains=self._said["gains"],
            reason=self._said["trip"] or self._said["reason"],
        )

    def forget(self) -> None:
        """Make the next ``look`` read the names again, after a command."""
        self._asked = -math.inf

    def slack(self) -> Slack:
        """The slack over the last second of ticks; u[k] is due when tick k + 1 begins."""
        done = self._run.done("plant")
        if not done:
            return Slack()
        left = SLACK.spread(self._run.columns, self._T_s, max(done - self._window, 0), done)
        return Slack(*(left.percentile(q) * 1e-3 for q in (50, 1, 0.1, 0))) if left else Slack()

    def laws(self) -> list[str]:
        """Names of the laws that the run can switch to, in order."""
        return [str(name) for name in self._operator.snapshot()["laws"]]
