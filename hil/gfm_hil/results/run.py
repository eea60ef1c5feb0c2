"""A finished run, in memory or in a folder: what happened, every signal, metrics, a figure."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.recording.log import read_log, read_summary
from gfm_hil.recording.npz import Table, write_npz
from gfm_hil.recording.recorder import read_recording
from gfm_hil.results.export.columns import describe
from gfm_hil.results.metrics import Rows
from gfm_hil.results.summary import controlled_by, nominal_frequency
from gfm_hil.scenario.model import Scenario
from gfm_hil.scenario.toml_out import scenario_toml
from gfm_runtime.toml_file import read_toml

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

_NOT_METRICS = ("t", "tick", "type", "label")
_HERTZ = "f_hz"  # omega_u in Hz


class Signals(Mapping[str, NDArray[Any]]):
    """The recorded signals by name, each of shape (ticks,), read when it is asked for.

    ``p``, ``q``, ``V``, ``v_dc``, ``omega_u``, ``i``, ``delta``, ``omega_g`` and ``V_g`` are the
    plant's own, without sensors; ``f_hz`` is omega_u in Hz; ``t`` is in s. All columns of the
    recording are there under their own names too: ``y_p`` as measured, ``u_E_u``, ``ref_P_ref``;
    iterating gives those.

    Args:
        columns: of signals.npz.
        f_n: nominal frequency, Hz.
    """

    def __init__(self, columns: Mapping[str, Rows], f_n: float) -> None:
        self._columns, self._f_n = columns, f_n
        self._names = [name.removeprefix("true_") for name in columns if name.startswith("true_")]
        if "true_omega_u" in columns:
            self._names.append(_HERTZ)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name == _HERTZ and name in self._names:
            return np.asarray(self._columns["true_omega_u"][:] * self._f_n)
        for known in (name, f"true_{name}"):
            if known in self._columns:
                return np.asarray(self._columns[known][:])
        there = sorted([*self._columns, *self._names])
        raise UserError(f"signal = {name!r}: was not recorded; there are {there}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns or name in self._names


@dataclass(frozen=True, repr=False)
class Run:
    """A finished run.

    Attributes:
        scenario: what was run.
        summary: content of summary.json.
        columns: of signals.npz, each shape (ticks,): an array, or a column of the file, of which
            a slice is read and nothing more.
        laws: labels of the laws, which the column ``law`` refers to.
        events: lines of events.jsonl.
        folder: where it is; None for a run in memory.
    """

    scenario: Scenario
    summary: dict[str, Any]
    columns: Mapping[str, Rows]
    laws: list[str] = field(default_factory=list)
    events: list[dict[str, Any]] = field(default_factory=list)
    folder: Path | None = None

    def file(self, name: str) -> Path:
        """The path of a file of the run folder.

        Raises:
            UserError: the run is in memory only.
        """
        if self.folder is None:
            raise UserError(f"{name}: the run is in memory; save it first")
        return self.folder / name

    @property
    def signals(self) -> Signals:
        """The signals by name, see ``Signals``; p.u. unless ``units`` says otherwise."""
        return Signals(self.columns, nominal_frequency(self.scenario))

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column; empty for codes."""
        return {name: describe(name, self.laws).unit for name in self.columns}

    @property
    def status(self) -> str:
        """``completed``, ``tripped``, ``safe`` or ``interrupted``."""
        return str(self.summary["status"])

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

    def to_pandas(self) -> pandas.DataFrame:
        """All columns as a DataFrame whose index is t in s.

        Raises:
            UserError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise UserError("to_pandas: needs pandas: pip install 'gfmhil[notebook]'") from None
        content = {name: column[:] for name, column in self.columns.items()}
        return pandas.DataFrame(content).set_index("t")

    def to_xarray(self) -> xarray.Dataset:
        """All columns as a Dataset over t, with units.

        Raises:
            UserError: xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise UserError("to_xarray: needs xarray: pip install 'gfmhil[notebook]'") from None
        units = self.units
        content = {
            name: ("t", column[:], {"units": units[name]})
            for name, column in self.columns.items()
            if name != "t"
        }
        about = {"title": self.scenario.title, "status": self.status}
        return xarray.Dataset(content, {"t": self.columns["t"][:]}, about)

    def save(self, folder: str | Path) -> Path:
        """Write the run folder, with figures and report; returns it.

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
            write_text(folder / "scenario.toml", scenario_toml(self.scenario))
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

    def __repr__(self) -> str:
        reason = f" ({self.summary['reason']})" if self.summary["reason"] else ""
        where = f", {self.folder}" if self.folder is not None else ""
        return (
            f"<Run {self.scenario.title!r}: {controlled_by(self.summary)}, {self.status}{reason}, "
            f"{self.summary['duration_s']:g} s in {self.summary['ticks']} ticks{where}>"
        )


def load_run(folder: str | Path) -> Run:
    """A run from its folder; no column is read yet.

    Raises:
        UserError: it is no run folder, the run is not over, or a file is damaged.
    """
    folder = Path(folder)
    try:
        columns, _, laws = read_recording(folder)
        summary = read_summary(folder)
        # The law files of the scenario may be gone; all else of it is in the file.
        scenario = Scenario.model_validate(read_toml(folder / "scenario.toml"))
    except FileNotFoundError as problem:
        going = (folder / "scenario.toml").is_file()
        what = "the run is not over, see gfmhil stream, or was cut off, see gfmhil recover"
        what = what if going else "is not a run folder"
        raise UserError(f"{folder}: {what} ({Path(problem.filename).name} is missing)") from None
    except (OSError, ValueError) as problem:
        raise UserError(f"{folder}: {problem}") from None
    return Run(scenario, summary, columns, laws, read_log(folder / "events.jsonl"), folder)
