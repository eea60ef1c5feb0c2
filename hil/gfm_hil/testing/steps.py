"""The setting of a test, its steps as calls, collected until a result is needed, and its results.

The steps make a scenario that runs as a whole. So a test is exact: each step belongs to a tick, on
every link and in real time too, and the scenario file repeats the test's run.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.recording.run import Run, Signals
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import INPROC, Scenario, check_scenario, load_scenario
from gfm_hil.scenario.events import AnyEvent
from gfm_runtime.signals import REF_NAMES

_PLAIN = "pref_step"  # used for its grid and converter; its step is dropped
_EVENT: TypeAdapter[Any] = TypeAdapter(AnyEvent)
_REFERENCES = {name.lower(): name for name in REF_NAMES}


class Unfit(UserError):
    """The test cannot run over the link of the command line."""


@dataclass(frozen=True)
class Setting:
    """One test's bench before its steps."""

    scenario: Scenario  # checked, with its own events
    # program and arguments of the user's controller process, or empty; ``{endpoint}`` and
    # ``{scenario}`` in it are replaced
    controller_command: tuple[str, ...]

    @property
    def realtime(self) -> bool:
        """Whether the run is in real time."""
        return self.scenario.mode == "realtime"


def beside(near: Path, name: str) -> str:
    """The path of a file beside the test, or the name unchanged: a path or a catalogue name."""
    found = near / name
    return str(found) if found.is_file() else name


def make_setting(
    near: Path,
    scenario: str | None = None,
    *,
    law: str | None = None,
    link: str | None = None,
    mode: str | None = None,
    controller_command: Sequence[str] = (),
    link_wanted: str | None = None,
    **changed: Any,
) -> Setting:
    """Read and check the setting of a test. Raises UserError: one line per mistake. ``Unfit`` if
    only ``link_wanted`` does not fit the test.

    Args:
        near: folder of the test, searched first for scenario and law files.
        scenario: shipped name or file; by default the paper's grid and converter, without events.
        law, link, mode: by default the scenario's law, in process, lockstep.
        controller_command: of the user's controller; the link is then zmq by default.
        link_wanted: link of the command line; replaces the test's link.
        changed: any other key of a scenario by its path with ``__`` for the dot, for example
            ``references__P_ref=0.2`` or ``events=[]``.
    """
    chosen = link or ("zmq" if controller_command else INPROC)
    if controller_command and chosen == INPROC:
        raise UserError("link = 'inproc': a controller_command is a process, which needs a link")
    if link_wanted not in (None, chosen):
        if controller_command:
            raise Unfit(f"the controller of this test is a process that talks {chosen}")
        if link_wanted == INPROC and mode == "realtime":
            raise Unfit("this test is about real time, which a run in process has not")
        if chosen != INPROC:  # they belong to the test's link
            changed = {k: v for k, v in changed.items() if not k.startswith("link__")}
        chosen = str(link_wanted)
    if scenario is None:
        changed = {"events": [], "title": "on the paper's grid", **changed}
    loaded = load_scenario(
        beside(near, scenario or _PLAIN),
        law=None if law is None else beside(near, law),
        link__type=chosen,
        mode=mode or "lockstep",
        **changed,
    )
    return Setting(loaded, tuple(map(str, controller_command)))


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
        Raises UserError: one line per mistake."""
        __tracebackhide__ = True
        try:
            self._setting = make_setting(
                self._near, scenario, link_wanted=self._link_wanted, **setting
            )
        except Unfit as problem:
            if self._skip is None:
                raise
            self._skip(f"--gfmhil-link {self._link_wanted}: {problem}")
        self._steps: list[Any] = []  # events besides the scenario's own
        self._tick = 0  # of the next step
        self._run: Run | None = None
        self._ran = 0  # planned ticks of ``_run``

    # steps

    def set(self, ramp_s: float = 0.0, **references: float) -> None:
        """New references: ``p_ref=1.0``, or spread over ``ramp_s`` seconds."""
        known = {_REFERENCES.get(k.lower(), k): float(v) for k, v in references.items()}
        self._step("reference", ramp_s=float(ramp_s), **known)

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
            self._step("grid-frequency", f_hz=f_hz, rate=rate, duration=duration)
        else:
            self._step("grid-voltage", V_g=V_g, rate=rate, duration=duration)

    def grid_profile(self, file: str) -> None:
        """The grid's frequency and voltage follow a CSV file from here on: t [s], and f_hz or
        omega_g [p.u.], V_g [p.u.], or both."""
        self._step("grid-profile", file=beside(self._near, file))

    def phase_jump(self, degrees: float) -> None:
        """The grid's angle jumps ahead."""
        self._step("grid-phase-jump", degrees=degrees)

    def grid_impedance(self, L_g: float, R_g: float | None = None) -> None:
        """The line gets ``L_g`` and ``R_g`` times its nominal elements; without ``R_g`` both get
        the factor ``L_g``: the same line, longer or shorter."""
        self._step("grid-impedance", L_g=L_g, R_g=L_g if R_g is None else R_g)

    def scr(self, scr: float, x_over_r: float) -> None:
        """The line becomes one of that short-circuit ratio, with that X/R."""
        self._step("grid-impedance", scr=scr, x_over_r=x_over_r)

    def grid_load(self, change: float) -> None:
        """The load of a finite grid changes, p.u. of the grid's rating."""
        self._step("grid-load", change=change)

    def irradiance(self, irradiance: float, rate: float | None = None, **more: Any) -> None:
        """Irradiance on the PV arrays, of 1000 W/m2: a step, or a ramp at ``rate`` [1/s]."""
        self._step("irradiance", irradiance=irradiance, rate=rate, **more)

    def grid_unbalance(
        self,
        retained: tuple[float, float, float] = (1.0, 1.0, 1.0),
        degrees: tuple[float, float, float] = (0.0, 0.0, 0.0),
        duration: float | None = None,
    ) -> None:
        """The grid's phases a, b, c keep a part of their voltage and jump in angle, for
        ``duration`` [s] or until another such step."""
        self._step(
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
        self._step("fault", position=position, R=R, duration=duration, kind=kind, **more)

    def clear_fault(self) -> None:
        """The fault is cleared."""
        self._step("fault-clear")

    def breaker(self, closed: bool) -> None:
        """The grid breaker opens onto the local load, or closes."""
        self._step("grid-breaker", closed=closed)

    def switch(self, law: str) -> None:
        """Change to another law, of the catalogue or a file, without a bump."""
        if self.setting.controller_command:
            raise UserError(f"law = {law!r}: the user's controller has its own laws")
        self._step("law", law=beside(self._near, law))

    def gains(self, **values: float) -> None:
        """New gains of the active law, by the names in its file, without a bump: ``D_p=0.02``."""
        if self.setting.controller_command:
            raise UserError("gains: the user's controller has its own gains")
        self._step("gains", values={name: float(v) for name, v in values.items()})

    def reset(self) -> None:
        """Return from a trip or the safe state to the start; needs ``after_trip="wait"``."""
        if self.setting.controller_command:
            raise UserError("reset: gfmhil cannot reset the user's controller")
        self._step("reset")

    def run(self, seconds: float | None = None) -> None:
        """Continue for a time [s]; without one, to the scenario's end."""
        base = self.setting.scenario
        ticks = base.ticks - self._tick if seconds is None else round(seconds / base.T_s)
        if ticks < 1:
            raise UserError(f"seconds = {seconds}: must be at least one tick of {base.T_s:g} s")
        self._tick += ticks

    def _step(self, kind: str, /, **fields: Any) -> None:
        """Add an event at the present tick. Raises UserError: a scenario cannot have such an
        event."""
        _ = self.setting  # starts the experiment
        given = {name: value for name, value in fields.items() if value is not None}
        try:
            event = _EVENT.validate_python({"type": kind, "tick": self._tick, **given})
        except ValidationError as problem:
            raise UserError(
                "; ".join(line.removeprefix(f"{kind}.") for line in lines(problem, AnyEvent))
            ) from None
        self._steps.append(event)
        try:
            self._scenario(self._tick + 1)  # checks laws, lines and breaker
        except UserError:
            self._steps.pop()
            raise

    def _events(self, ticks: int) -> list[Any]:
        """The events of the first ``ticks`` ticks in order; within a tick the scenario's first."""
        base = self.setting.scenario
        every = [*base.sorted_events(), *self._steps]
        return sorted((e for e in every if e.at(base.T_s) < ticks), key=lambda e: e.at(base.T_s))

    def _scenario(self, ticks: int) -> Scenario:
        """The first ``ticks`` ticks as a scenario. Raises UserError: a step is impossible, for
        example its law does not exist."""
        base = self.setting.scenario
        content = base.model_dump(exclude_none=True)
        content["duration"] = ticks * base.T_s
        content["events"] = [e.model_dump(exclude_none=True) for e in self._events(ticks)]
        return check_scenario(content, base.title)

    # results

    @property
    def setting(self) -> Setting:
        """The setting of the experiment."""
        if self._setting is None:
            self.start()
        assert self._setting is not None
        return self._setting

    @property
    def time(self) -> float:
        """Simulated time of the next step, s."""
        T_s = self.setting.scenario.T_s
        return self._tick * T_s

    @property
    def pending(self) -> bool:
        """Whether planned ticks were never run."""
        return self._setting is not None and self._tick > self._ran

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
        """The run of all steps so far. Raises UserError: there is nothing to run, or the run cannot
        be repeated."""
        setting, before = self.setting, self._run
        if before is not None and self._ran == self._tick:
            return before
        if self._tick == 0:
            raise UserError("nothing has been run: call run(seconds) before you read results")
        if before is not None and setting.realtime:
            raise UserError(
                "in real time a run cannot be repeated: make all steps before you read results, "
                "or begin anew with start()"
            )
        run = run_scenario(
            self._scenario(self._tick),
            self._new_folder(),
            controller_command=setting.controller_command,
        )
        if run.summary["reason"].startswith("stopped by the operator"):
            raise KeyboardInterrupt
        if before is not None and not _same(before.signals, run.signals):
            raise UserError(
                "the same steps gave another run: a controller that does not repeat itself must be "
                f"asked for results only at the end ({before.folder}, {run.folder})"
            )
        self._run, self._ran = run, self._tick
        return run


def _same(one: Mapping[str, NDArray[Any]], other: Mapping[str, NDArray[Any]]) -> bool:
    """Whether both hold the same values as far as the shorter one goes."""
    length = min(len(one["tick"]), len(other["tick"]))
    return all(
        np.array_equal(one[name][:length], other[name][:length], equal_nan=True)
        for name in one
        if name in other
    )
