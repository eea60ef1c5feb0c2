"""An experiment in a test: steps as calls, run when first looked at, and assertions about it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from gfm_hil.errors import UserError
from gfm_hil.run_folder import Run
from gfm_hil.runner import run_scenario
from gfm_hil.summary import nominal_frequency
from gfm_hil.testing import checks
from gfm_hil.testing.plan import Plan
from gfm_hil.testing.setting import Setting, Unfit, beside, make_setting
from gfm_hil.testing.signals import Signals, same
from gfm_runtime.signals import REF_NAMES

_REFERENCES = {name.lower(): name for name in REF_NAMES}


class Experiment:
    """What the fixture ``bench`` gives a test.

    Steps (``set``, ``grid``, ``phase_jump``, ``switch``, …, ``run``) are gathered; the whole
    experiment is run from its beginning when something is first asked of it. Each step thereby
    happens at its tick exactly, on every link. Steps after that are run again from the beginning
    too, which in lockstep gives the same ticks again (it is checked); in real time it would be
    another run, and is refused.

    Args:
        near: folder of the test, where scenario and law files are looked for first.
        new_folder: called for the folder of each run.
        link_wanted: link of the command line, instead of the test's.
        notice: told of each figure that an assertion leaves.
        skip: told why a test cannot be run over ``link_wanted``; must not return.
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
        """Begin anew; arguments as of ``make_setting``.

        Raises:
            UserError: one line a mistake.
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
        self._plan = Plan(self._setting.scenario)
        self._run: Run | None = None
        self._ran = 0  # ticks of the plan that ``_run`` was to have

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

    def phase_jump(self, degrees: float) -> None:
        """The grid's angle jumps ahead."""
        self._planned.step("grid-phase-jump", degrees=degrees)

    def grid_impedance(self, L_g: float, R_g: float | None = None) -> None:
        """The line becomes so many times its nominal elements; without ``R_g`` it is the same
        line, longer or shorter."""
        self._planned.step("grid-impedance", L_g=L_g, R_g=L_g if R_g is None else R_g)

    def breaker(self, closed: bool) -> None:
        """The grid breaker opens onto the local load, or closes."""
        self._planned.step("grid-breaker", closed=closed)

    def switch(self, law: str) -> None:
        """Change to another law, of the catalogue or a file, bumpless."""
        plan = self._planned
        if self.setting.controller_command:
            raise UserError(f"law = {law!r}: a controller of one's own has laws of its own")
        plan.step("law", law=beside(self._near, law))

    def run(self, seconds: float | None = None) -> None:
        """Go on for a time [s]; without one, to the scenario's end."""
        self._planned.run(seconds)

    # results

    @property
    def setting(self) -> Setting:
        """What the experiment runs on."""
        if self._setting is None:
            self.start()
        assert self._setting is not None
        return self._setting

    @property
    def time(self) -> float:
        """Simulated time of the next step, s."""
        return self._planned.tick * self.setting.scenario.T_s

    @property
    def pending(self) -> bool:
        """There are ticks planned that were never run."""
        return self._setting is not None and self._plan.tick > self._ran

    @property
    def signals(self) -> Signals:
        """What was recorded, by name; see ``Signals``."""
        return Signals(self.result.signals, nominal_frequency(self.setting.scenario))

    @property
    def summary(self) -> dict[str, Any]:
        """Content of summary.json."""
        return self.result.summary

    @property
    def folder(self) -> Path:
        """The run folder, whose scenario.toml repeats the run."""
        return self.result.folder

    @property
    def result(self) -> Run:
        """The run of all steps so far.

        Raises:
            UserError: nothing to run, or nothing that could be run again.
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
            figures=False,
            controller_command=self.setting.controller_command,
        )
        if run.summary["reason"] == "stopped by the operator":
            raise KeyboardInterrupt
        if before is not None and not same(before.signals, run.signals):
            raise UserError(
                "the same steps gave another run: a controller that does not repeat itself must be "
                f"asked for results only at the end ({before.folder}, {run.folder})"
            )
        self._run, self._ran = run, plan.tick
        return run

    @property
    def _planned(self) -> Plan:
        return self._plan if self._setting is not None else self._begun()

    def _begun(self) -> Plan:
        self.start()
        return self._plan

    # assertions

    def assert_settles(
        self,
        signal: str,
        to: float,
        within: float,
        tolerance: float = 0.02,
        since: float | None = None,
    ) -> None:
        """From ``within`` s after the last step (or ``since``, s) on, to the end, the signal is
        ``to`` ± ``tolerance``."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        self._judge(w.name, "settles", checks.settles(w, to, within, tolerance))

    def assert_overshoot_below(
        self,
        signal: str,
        percent: float,
        to: float | None = None,
        since: float | None = None,
    ) -> None:
        """After the last step the signal goes beyond ``to`` (by default, its final value) by at
        most ``percent`` of its step."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        self._judge(w.name, "overshoot", checks.overshoot(w, percent, to))

    def assert_within_envelope(
        self,
        signal: str,
        low: float | None = None,
        high: float | None = None,
        csv: str | Path | None = None,
        since: float | None = None,
    ) -> None:
        """After the last step the signal stays between two numbers, or two curves of a file with
        the columns t (s after the step), low, high."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        if (csv is None) == (low is None and high is None):
            raise UserError(f"low = {low}, high = {high}, csv = {csv}: give limits or a file")
        if csv is not None:
            lower, upper = checks.read_envelope(Path(beside(self._near, str(csv))), w.t - w.since)
        else:
            lower, upper = (
                np.full(len(w.t), np.nan if limit is None else limit) for limit in (low, high)
            )
        self._judge(w.name, "envelope", checks.envelope(w, lower, upper))

    def assert_damped(
        self, min_ratio: float, signal: str = "p", since: float | None = None
    ) -> None:
        """The strongest oscillation after the last step has at least this damping ratio."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        T_s = self.setting.scenario.T_s
        self._judge(w.name, "damped", checks.damped(w, min_ratio, T_s))

    def assert_bump_below(self, limit: float) -> None:
        """No change of law moved an input by more than ``limit`` p.u. in its tick."""
        __tracebackhide__ = True
        self.assert_no_trip()
        changes = [e for e in self.summary["events"] if e["type"] == "law"]
        if not changes:
            raise UserError("assert_bump_below: the law was never changed; use switch() first")
        worst = max(changes, key=lambda e: np.inf if e["bump_pu"] is None else e["bump_pu"])
        if worst["bump_pu"] is None or worst["bump_pu"] > limit:
            bump = "unknown" if worst["bump_pu"] is None else f"{worst['bump_pu']:.3g} p.u."
            self._fail(
                f"The change to {worst['label']} at t = {worst['t']:g} s should move no input by "
                f"more than {limit:g} p.u., but its bump was {bump}.",
                "u_E_u", "bump",
            )  # fmt: skip

    def assert_no_miss(self, at_most: int = 0) -> None:
        """In real time at most so many ticks went without a fresh u; in lockstep, which has no
        deadlines, none is ever missed."""
        __tracebackhide__ = True
        missed = self.summary["misses"]
        self.assert_no_trip()
        if missed > at_most:
            trip = self.summary["round_trip_us"] or {}
            slow = ", ".join(f"{name} {us:g} µs" for name, us in trip.items())
            self._fail(
                f"At most {at_most} of {self.summary['ticks']} ticks should go without a fresh u, "
                f"but {missed} did; round trips: {slow}; faults: {self.summary['faults']}.",
                "p", "miss",
            )  # fmt: skip

    def assert_no_trip(self) -> None:
        """The run came to its end."""
        __tracebackhide__ = True
        s = self.summary
        if s["status"] != "completed":
            self._fail(
                f"The run should last {self._ran * s['T_s']:g} s, but it ended at "
                f"{s['duration_s']:.4f} s: {s['status']}: {s['reason']}.",
                "p", "trip",
            )  # fmt: skip

    def _window(self, signal: str, since: float | None) -> checks.Window:
        """The signal after the last step, of a run that came to its end."""
        __tracebackhide__ = True
        self.assert_no_trip()
        signals, T_s = self.signals, self.setting.scenario.T_s
        if since is None:
            events = self._plan.events(self._ran)
            first = events[-1].at(T_s) if events else 0
        else:
            first = round(since / T_s)
        if not 0 <= first < self._ran:
            raise UserError(f"since = {since}: must lie in [0, {self._ran * T_s:g}) s")
        x = signals[signal]
        return checks.Window(
            signal, signals["t"][first:], x[first:], float(x[max(first - 1, 0)]), first * T_s
        )

    def _judge(self, signal: str, what: str, finding: checks.Finding | None) -> None:
        __tracebackhide__ = True
        if finding is not None:
            self._fail(finding.text, signal, what, finding)

    def _fail(
        self, text: str, signal: str, what: str, finding: checks.Finding | None = None
    ) -> None:
        """Draw why, and say where."""
        __tracebackhide__ = True
        from gfm_hil.testing.picture import draw  # half a second, which only failures need

        run, scenario = self.result, self._plan.scenario(self._ran)
        steps = [
            (e.at(scenario.T_s) * scenario.T_s, e.label()) for e in self._plan.events(self._ran)
        ]
        lines = [text]
        if len(run.signals["tick"]):
            figure = run.folder / f"{what}_{signal}.png"
            draw(figure, text, signal, self.signals, steps, finding)
            self._notice(figure)
            lines.append(f"figure: {figure}")
        laws = " → ".join(run.summary["laws"])
        lines.insert(
            1,
            f"run: {laws} over {run.summary['link']}, {run.summary['mode']}; steps: "
            + ("; ".join(f"{label} at {t:g} s" for t, label in steps) or "none"),
        )
        if not self.setting.controller_command:
            lines.append(f"again: gfmhil run {run.folder / 'scenario.toml'}")
        raise AssertionError("\n".join(lines))
