"""A finished run with what can be made of it: metrics, figures, a folder with a report."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.recording.npz import Table, write_npz
from gfm_hil.recording.run import RecordedRun, bases
from gfm_hil.results.waveforms import three_phase
from gfm_hil.scenario import write_scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NOT_METRICS = ("t", "tick", "type", "label")


class Run(RecordedRun):
    __doc__ = RecordedRun.__doc__

    @property
    def metrics(self) -> dict[str, dict[str, Any]]:
        """What each event brought, by ``label @ t s`` (overshoot, settling, nadir and more, with
        the units of their names)."""
        return {
            f"{event['label']} @ {event['t']:g} s": {
                key: value for key, value in event.items() if key not in _NOT_METRICS
            }
            for event in self.summary["events"]
        }

    def plot(self, *names: str) -> list[Axes]:
        """Draw signals over time, one a panel; without names the six panels of the report.

        Raises:
            UserError: a signal that was not recorded.
        """
        from matplotlib import pyplot

        from gfm_hil.results import figures  # both take longer to import than a run takes

        if not names:
            figure = pyplot.figure(figsize=figures.SIZE, layout="constrained")
            return figures.draw_signals(figure, self.scenario, self.columns, self.summary)
        signals = self.signals
        curves = [(signals["t"], signals[name], name) for name in names]
        figure, axes = pyplot.subplots(
            len(names), 1, sharex=True, squeeze=False, layout="constrained",
            figsize=(8.6, 2.2 * len(names)),
        )  # fmt: skip
        for a, (t, x, name) in zip(axes[:, 0], curves, strict=True):
            figures.draw_panel(a, name, [(t, x, figures.COLOURS[0], name)])
        axes[-1, 0].set_xlabel("t [s]")
        return list(axes[:, 0])

    def three_phase(
        self, start: float = 0.0, stop: float = math.inf, si: bool = False
    ) -> dict[str, NDArray[Any]]:
        """v_abc of the filter capacitor and i_abc of the bridge and of the line, at every tick.

        Args:
            start, stop: from when to before when, s.
            si: in V and A instead of in p.u. of the nominal peak value of a phase.

        Returns:
            ``t`` in s, and v_a … v_c, i_a … i_c, i_oa … i_oc, in V and A under names such as v_a_V
            and i_oa_A; shape (ticks,) each.

        Raises:
            UserError: the recording lacks what this needs.
        """
        waves = three_phase(self.columns, bases(self.scenario), si)
        first, last = (
            round(min(max(0.0, t / self.scenario.T_s), self.ticks)) for t in (start, stop)
        )
        rows = {"t": self.columns["t"], **waves}
        return {name: np.asarray(column[first:last]) for name, column in rows.items()}

    def plot_waveforms(self, start: float | None = None, stop: float | None = None) -> list[Axes]:
        """Draw the three phases of the voltages and currents, as the report does.

        Args:
            start, stop: from when to when, s; the window of the report if not given.

        Raises:
            UserError: only one of them is given, nothing was recorded between them, or the
                recording lacks what this needs.
        """
        from matplotlib import pyplot

        from gfm_hil.results import figures

        if (start is None) != (stop is None):
            raise UserError(f"start = {start}, stop = {stop}: give both or neither")
        window = None if start is None or stop is None else (start, stop)
        figure = pyplot.figure(figsize=figures.SIZE_WAVES, layout="constrained")
        axes = figures.draw_waveforms(figure, self.scenario, self.columns, self.summary, window)
        if not axes:
            pyplot.close(figure)
            end = self.summary["duration_s"]
            raise UserError(f"start = {start}, stop = {stop}: the recording ends at {end:g} s")
        return axes

    def save(self, folder: str | Path) -> Path:
        """Write the run folder, with figures and report; returns it.

        A law that was an object is there as ``law.toml``, which the scenario names.

        Raises:
            UserError: the folder holds something already, or cannot be written.
        """
        from gfm_hil.results.diagram import draw_diagram
        from gfm_hil.results.figures import draw_run
        from gfm_hil.results.report import write_report

        folder = Path(folder)
        if folder.exists() and any(folder.iterdir()):
            raise UserError(f"{folder}: is not empty; choose another folder")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if self.folder is not None:
                shutil.copytree(self.folder, folder, dirs_exist_ok=True)
                return folder
            arrays = {name: np.asarray(column[:]) for name, column in self.columns.items()}
            scenario = self.scenario
            if self.law_text:
                law = folder.absolute() / "law.toml"
                write_text(law, self.law_text)
                scenario = scenario.model_copy(update={"law": str(law)})
            write_scenario(folder, scenario)
            laws = Table.of(laws=np.array(self.laws))
            write_npz(folder / "signals.npz", [laws, Table.of(**arrays)])
            write_npz(folder / "timing.npz", [])
            lines = "".join(json.dumps(event) + "\n" for event in self.events)
            write_text(folder / "events.jsonl", lines)
            pictures = draw_run(folder, self.scenario, arrays, {}, self.summary)
            diagram = draw_diagram(folder, self.scenario)
            write_report(folder, self.scenario, self.summary, pictures, diagram)
            write_text(folder / "summary.json", json.dumps(self.summary, indent=2) + "\n")
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}") from None
        return folder


def load_run(folder: str | Path) -> Run:
    """A run from its folder, see ``RecordedRun.load``."""
    return Run.load(folder)
