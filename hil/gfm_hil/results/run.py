"""A finished run with what can be made of it: metrics, figures, a folder with a report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.recording.npz import Table, write_npz
from gfm_hil.recording.run import RecordedRun
from gfm_hil.scenario.toml_out import write_scenario

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

    def save(self, folder: str | Path) -> Path:
        """Write the run folder, with figures and report; returns it.

        A law that was an object is there as ``law.toml``, which the scenario names.

        Raises:
            UserError: the folder holds something already, or cannot be written.
        """
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
            write_report(folder, self.scenario, self.summary, pictures)
            write_text(folder / "summary.json", json.dumps(self.summary, indent=2) + "\n")
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}") from None
        return folder


def load_run(folder: str | Path) -> Run:
    """A run from its folder, see ``RecordedRun.load``."""
    return Run.load(folder)
