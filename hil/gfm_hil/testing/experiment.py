"""A test's assertions about an experiment; they explain how they fail and draw a figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.recording.run import nominal_frequency
from gfm_hil.run import checks
from gfm_hil.run.modes import acting, free_from, oscillations
from gfm_hil.testing.steps import Steps, beside

_NEAR = 0.02  # s that a figure shows on each side of a moment


class Experiment(Steps):
    """The object of the fixture ``bench``: steps, results, and assertions.

    An assertion about a signal checks it from the last step, or from ``since`` (s), to the end, and
    fails if the run did not complete.
    """

    def assert_settles(
        self, signal: str, to: float, within: float, tolerance: float = 0.02,
        since: float | None = None,
    ) -> None:  # fmt: skip
        """From ``within`` s after the last step (or ``since``, s) to the end, the signal is
        ``to`` ± ``tolerance``."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        self._judge(w.name, "settles", checks.settles(w, to, within, tolerance))

    def assert_overshoot_below(
        self, signal: str, percent: float, to: float | None = None, since: float | None = None
    ) -> None:
        """After the last step the signal exceeds ``to`` (by default its final value) by at most
        ``percent`` of its step."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        self._judge(w.name, "overshoot", checks.overshoot(w, percent, to))

    def assert_within_envelope(
        self, signal: str, low: float | None = None, high: float | None = None,
        csv: str | Path | None = None, since: float | None = None,
    ) -> None:  # fmt: skip
        """After the last step the signal stays between two numbers, or between two curves of a
        file with the columns t (s after the step), low, high."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        if (csv is None) == (low is None and high is None):
            raise UserError(f"low = {low}, high = {high}, csv = {csv}: give limits or a file")
        if csv is not None:
            limits = checks.read_envelope(Path(beside(self._near, str(csv))), w.t - w.since)
        else:
            constant = (np.full(len(w.t), np.nan if x is None else x) for x in (low, high))
            limits = next(constant), next(constant)
        self._judge(w.name, "envelope", checks.envelope(w, *limits))

    def assert_damped(
        self, min_ratio: float, signal: str = "p", since: float | None = None
    ) -> None:
        """The swing after the last step and the end of its ramp (below half the nominal frequency)
        has at least this damping ratio, and no faster oscillation grows."""
        __tracebackhide__ = True
        w = self._window(signal, since)
        scenario = self.result.scenario
        first, ran = round(w.since / scenario.T_s), self.result.ticks
        free = free_from(acting(scenario, self.result.columns, ran), first, ran) - first
        if free >= len(w.x):
            raise UserError("assert_damped: a ramp is not over at the end of the run")
        w = replace(w, t=w.t[free:], x=w.x[free:])
        modes = oscillations(w.x, scenario.T_s, nominal_frequency(scenario))
        self._judge(w.name, "damped", checks.damped(w, min_ratio, modes))

    def assert_bump_below(self, limit: float) -> None:
        """No change of law moved an input by more than ``limit`` p.u. in its tick."""
        __tracebackhide__ = True
        self.assert_no_trip()
        changes = [e for e in self.summary["events"] if e["type"] == "law"]
        if not changes:
            raise UserError("assert_bump_below: the law was never changed; use switch() first")
        worst = max(changes, key=lambda e: np.inf if e["bump_pu"] is None else e["bump_pu"])
        if worst["bump_pu"] is None or worst["bump_pu"] > limit:
            bump = "one unknown" if worst["bump_pu"] is None else f"{worst['bump_pu']:.3g} p.u"
            self._fail(
                f"The change to {worst['label']} at t = {worst['t']:g} s should move no input by "
                f"more than {limit:g} p.u., but its bump was {bump}.",
                "u_E_u", "bump", around=(worst["t"] - _NEAR, worst["t"] + _NEAR),
            )  # fmt: skip

    def assert_no_miss(self, at_most: int = 0) -> None:
        """In real time, at most ``at_most`` ticks had no fresh u; lockstep has no deadlines, so
        that it never misses one."""
        __tracebackhide__ = True
        missed = self.summary["misses"]
        self.assert_no_trip()
        if missed > at_most:
            times = self.summary["round_trip_us"] or {}
            slow = ", ".join(f"{name} {us:g} µs" for name, us in times.items())
            self._fail(
                f"At most {at_most} of {self.summary['ticks']} ticks should go without a fresh u, "
                f"but {missed} did; round trips: {slow}; faults: {self.summary['faults']}.",
                "u", "miss",
            )  # fmt: skip

    def assert_no_trip(self) -> None:
        """The run completed; one that still oscillates at its end has not, unless its scenario
        expects that."""
        __tracebackhide__ = True
        s = self.summary
        end = s["duration_s"]
        if s["status"] == "oscillating" != s["expected"]:
            self._fail(
                f"The run should be at rest at its end, but it is {s['reason']}.",
                "i", "oscillates", around=(end - _NEAR, end),
            )  # fmt: skip
        if s["status"] not in ("completed", "oscillating"):
            self._fail(
                f"The run should last {self._ran * s['T_s']:g} s, but it ended at {end:.4f} s: "
                f"{s['status']}: {s['reason']}.",
                "i", "trip", around=(end - _NEAR, end),
            )  # fmt: skip

    def _window(self, signal: str, since: float | None) -> checks.Window:
        """The signal after the last step, of a completed run."""
        __tracebackhide__ = True
        self.assert_no_trip()
        signals, T_s = self.signals, self.setting.scenario.T_s
        if since is None:
            events = self._events(self._ran)
            first = events[-1].at(T_s) if events else 0
        else:
            first = round(since / T_s)
        if not 0 <= first < self._ran:
            raise UserError(f"since = {since}: must lie in [0, {self._ran * T_s:g}) s")
        x = signals[signal]
        return checks.Window(
            signal, signals["t"][first:], x[first:], float(x[max(first - 1, 0)]), first * T_s
        )

    def _judge(self, signal: str, what: str, finding: checks.Violation | None) -> None:
        __tracebackhide__ = True
        if finding is not None:
            self._fail(finding.text, signal, what, finding)

    def _fail(
        self, text: str, signal: str, what: str, finding: checks.Violation | None = None,
        around: tuple[float, float] | None = None,
    ) -> None:  # fmt: skip
        """Draw the figure of a failure and fail with its path."""
        __tracebackhide__ = True
        run, T_s = self.result, self.setting.scenario.T_s
        steps = [(e.at(T_s) * T_s, e.label()) for e in self._events(self._ran)]
        done = "; ".join(f"{label} at {t:g} s" for t, label in steps) or "none"
        link, mode = run.summary["link"], run.summary["mode"]
        lines = [text, f"run: {' → '.join(run.summary['laws'])} over {link}, {mode}; steps: {done}"]
        if len(run.signals["tick"]):
            # takes half a second to import, and only failures need it
            from gfm_hil.results.figures import draw_timing
            from gfm_hil.testing.picture import draw

            figure = run.file(f"{what}_{signal}.png")
            if what == "miss":  # when it was late, as in its report
                draw_timing(run).path.rename(figure)
            else:
                draw(figure, text, signal, self.signals, steps, finding, around)
            self._notice(figure)
            lines.append(f"figure: {figure}")
        if not self.setting.controller_command:
            lines.append(f"again: gfmhil run {run.file('scenario.toml')}")
        raise AssertionError("\n".join(lines))
