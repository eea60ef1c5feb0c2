"""An experiment's steps as calls, collected until a result is needed, and its results.

The steps make a scenario that runs as a whole. So a test is exact: each step belongs to a tick, on
every link and in real time too, and the scenario file repeats the test's run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.recording.run import Run, Signals
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import Scenario, check_scenario
from gfm_hil.scenario.events import AnyEvent
from gfm_hil.testing.setting import Setting, Unfit, beside, make_setting
from gfm_runtime.signals import REF_NAMES

_EVENT: TypeAdapter[Any] = TypeAdapter(AnyEvent)
_REFERENCES = {name.lower(): name for name in REF_NAMES}


class StepPlan:
    """Events and duration of a test, in addition to a scenario's own events."""

    def __init__(self, base: Scenario) -> None:
        self.base = base
        self.tick = 0  # of the next step
        self._steps: list[Any] = []

    def step(self, kind: str, /, **fields: Any) -> None:
        """Add an event at the present tick, after the ticks planned so far. Raises UserError: a
        scenario cannot have such an event."""
        given = {name: value for name, value in fields.items() if value is not None}
        try:
            event = _EVENT.validate_python({"type": kind, "tick": self.tick, **given})
        except ValidationError as problem:
            raise UserError(
                "; ".join(line.removeprefix(f"{kind}.") for line in lines(problem, AnyEvent))
            ) from None
        self._steps.append(event)
        try:
            self.scenario(self.tick + 1)  # checks laws, lines and breaker
        except UserError:
            self._steps.pop()
            raise

    def run(self, seconds: float | None) -> None:
        """Continue for a time, rounded to whole ticks; without one, to the base scenario's end."""
        T_s = self.base.T_s
        ticks = self.base.ticks - self.tick if seconds is None else round(seconds / T_s)
        if ticks < 1:
            raise UserError(f"seconds = {seconds}: must be at least one tick of {T_s:g} s")
        self.tick += ticks

    def events(self, ticks: int) -> list[Any]:
        """The events of the first ``ticks`` ticks in order; within a tick the scenario's first."""
        T_s = self.base.T_s
        every = [*self.base.sorted_events(), *self._steps]
        return sorted((e for e in every if e.at(T_s) < ticks), key=lambda e: e.at(T_s))

    def scenario(self, ticks: int) -> Scenario:
        """The first ``ticks`` ticks as a scenario. Raises UserError: a step is impossible, for
        example its law does not exist."""
        content = self.base.model_dump(exclude_none=True)
        content["duration"] = ticks * self.base.T_s
        content["events"] = [e.model_dump(exclude_none=True) for e in self.events(ticks)]
        return check_scenario(content, self.base.title)


class Steps:
    """Steps and results of an experiment.

    Steps (``set``, ``grid``, ``phase_jump``, ``switch``, …, ``run``) are collected; the first
    access to a result runs the whole experiment from its beginning. So each step happens at its
    exact tick on every link. Steps after a result run the experiment from the beginning again: in
    lockstep this repeats the same ticks (which is checked); in real time it would be another run,
    and is refused.

    Args:
        near: folder of the test, searched first for scenario and law files.
        new_folder: called for the folder of each run.
        link_wanted: link of the command line, replaces the test's.
        notice: called with each figure that an assertion draws.
        skip: called with the reason why a test cannot run over ``link_wanted``; must not return.
    """

    def __init__(
        self,
        near: Path,
        new_folder: Callable[[], Path],
        link_wanted: str | None = None,
        notice: Callable[[Path], None] = lambda figure: None,
        skip: Callable[[str], NoReturn] | None = None,
    ) -> None:
        self._near, self._new_folder = near, new_folder
        self._link_wanted, self._notice, self._skip = link_wanted, notice, skip
        self._setting: Setting | None = None

    def start(self, scenario: str | None = None, **setting: Any) -> None:
        """Start a new experiment; the arguments are those of ``make_setting`` and of the marker.

        Raises:
            UserError: one line per mistake.
        """
        __tracebackhide__ = True
        try:
            self._setting = make_setting(
                self._near, scenario, link_wanted=self._link_wanted, **setting
            )
        except Unfit as problem:
            if self._skip is None:
                raise
            self._skip(f"--gfmhil-link {self._link_wanted}: {problem}")
        self._plan = StepPlan(self._setting.scenario)
        self._run: Run | None = None
        self._ran = 0  # planned ticks of ``_run``

    # steps

    def set(self, ramp_s: float = 0.0, **references: float) -> None:
        """New references: ``p_ref=1.0``, or spread over ``ramp_s`` seconds."""
        known = {_REFERENCES.get(k.lower(), k): float(v) for k, v in references.items()}
        self._planned.step("reference", ramp_s=float(ramp_s), **known)

    def grid(
        self,
        f_hz: float | None = None,
        V_g: float | None = None,
        rate: float | None = None,
        duration: float | None = None,
    ) -> None:
        """Grid frequency [Hz] or voltage [p.u.]: a step, a ramp at ``rate`` [1/s], or of the
        voltage a sag of ``duration`` [s]."""
        if (f_hz is None) == (V_g is None):
            raise UserError(f"f_hz = {f_hz}, V_g = {V_g}: give one of them")
        if V_g is None:
            self._planned.step("grid-frequency", f_hz=f_hz, rate=rate, duration=duration)
        else:
            self._planned.step("grid-voltage", V_g=V_g, rate=rate, duration=duration)

    def grid_profile(self, file: str) -> None:
        """The grid's frequency and voltage follow a CSV file from here on: t [s], and f_hz or
        omega_g [p.u.], V_g [p.u.], or both."""
        self._planned.step("grid-profile", file=beside(self._near, file))

    def phase_jump(self, degrees: float) -> None:
        """The grid's angle jumps ahead."""
        self._planned.step("grid-phase-jump", degrees=degrees)

    def grid_impedance(self, L_g: float, R_g: float | None = None) -> None:
        """The line gets ``L_g`` and ``R_g`` times its nominal elements; without ``R_g`` both get
        the factor ``L_g``: the same line, longer or shorter."""
        self._planned.step("grid-impedance", L_g=L_g, R_g=L_g if R_g is None else R_g)

    def scr(self, scr: float, x_over_r: float) -> None:
        """The line becomes one of that short-circuit ratio, with that X/R."""
        self._planned.step("grid-impedance", scr=scr, x_over_r=x_over_r)

    def grid_load(self, change: float) -> None:
        """The load of a finite grid changes, p.u. of the grid's rating."""
        self._planned.step("grid-load", change=change)

    def grid_unbalance(
        self,
        retained: tuple[float, float, float] = (1.0, 1.0, 1.0),
        degrees: tuple[float, float, float] = (0.0, 0.0, 0.0),
        duration: float | None = None,
    ) -> None:
        """The grid's phases a, b, c keep a part of their voltage and jump in angle, for
        ``duration`` [s] or until another such step."""
        self._planned.step(
            "grid-unbalance", retained=list(retained), degrees=list(degrees), duration=duration
        )

    def fault(
        self,
        position: float,
        R: float,
        duration: float | None = None,
        kind: str = "3ph",
        **more: Any,
    ) -> None:
        """A fault through ``R`` [p.u.], at 0 (filter) to 1 (grid) of the line, for ``duration`` [s]
        or until ``clear_fault``; ``kind`` is "3ph", "LG", "LL" or "LLG", and ``more`` are the other
        keys of the event."""
        self._planned.step("fault", position=position, R=R, duration=duration, kind=kind, **more)

    def clear_fault(self) -> None:
        """The fault is cleared."""
        self._planned.step("fault-clear")

    def breaker(self, closed: bool) -> None:
        """The grid breaker opens onto the local load, or closes."""
        self._planned.step("grid-breaker", closed=closed)

    def switch(self, law: str) -> None:
        """Change to another law, of the catalogue or a file, without a bump."""
        plan = self._planned
        if self.setting.controller_command:
            raise UserError(f"law = {law!r}: the user's controller has its own laws")
        plan.step("law", law=beside(self._near, law))

    def gains(self, **values: float) -> None:
        """New gains of the active law, by the names in its file, without a bump: ``D_p=0.02``."""
        if self.setting.controller_command:
            raise UserError("gains: the user's controller has its own gains")
        self._planned.step("gains", values={name: float(v) for name, v in values.items()})

    def reset(self) -> None:
        """Return from a trip or the safe state to the start; needs ``after_trip="wait"``."""
        if self.setting.controller_command:
            raise UserError("reset: gfmhil cannot reset the user's controller")
        self._planned.step("reset")

    def run(self, seconds: float | None = None) -> None:
        """Continue for a time [s]; without one, to the scenario's end."""
        self._planned.run(seconds)

    # results

    @property
    def setting(self) -> Setting:
        """The setting of the experiment."""
        if self._setting is None:
            self.start()
        assert self._setting is not None
        return self._setting

    @property
    def _planned(self) -> StepPlan:
        _ = self.setting  # starts the experiment
        return self._plan

    @property
    def time(self) -> float:
        """Simulated time of the next step, s."""
        return self._planned.tick * self.setting.scenario.T_s

    @property
    def pending(self) -> bool:
        """Whether planned ticks were never run."""
        return self._setting is not None and self._plan.tick > self._ran

    @property
    def signals(self) -> Signals:
        """The recorded signals by name; see ``Signals``."""
        return self.result.signals

    @property
    def summary(self) -> dict[str, Any]:
        """Content of summary.json."""
        return self.result.summary

    @property
    def folder(self) -> Path:
        """The run folder, whose scenario.toml repeats the run."""
        return self.result.file("scenario.toml").parent

    @property
    def result(self) -> Run:
        """The run of all steps so far.

        Raises:
            UserError: there is nothing to run, or the run cannot be repeated.
        """
        plan, before = self._planned, self._run
        if before is not None and self._ran == plan.tick:
            return before
        if plan.tick == 0:
            raise UserError("nothing has been run: call run(seconds) before asking for results")
        if before is not None and self.setting.realtime:
            raise UserError(
                "in real time a run cannot be repeated: make all steps before asking for results, "
                "or begin anew with start()"
            )
        run = run_scenario(
            plan.scenario(plan.tick),
            self._new_folder(),
            controller_command=self.setting.controller_command,
        )
        if run.summary["reason"] == "stopped by the operator":
            raise KeyboardInterrupt
        if before is not None and not _same(before.signals, run.signals):
            raise UserError(
                "the same steps gave another run: a controller that does not repeat itself must be "
                f"asked for results only at the end ({before.folder}, {run.folder})"
            )
        self._run, self._ran = run, plan.tick
        return run


def _same(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Whether both hold the same values as far as the shorter one goes."""
    length = min(len(one["tick"]), len(other["tick"]))
    return all(
        np.array_equal(one[name][:length], other[name][:length], equal_nan=True)
        for name in one
        if name in other
    )
