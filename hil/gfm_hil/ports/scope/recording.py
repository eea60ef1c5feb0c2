"""The recording behind a scope: of a run in progress or of a finished one."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.engine.announcement import read_announcement, running_roles
from gfm_hil.ports.port import has_recording
from gfm_hil.recording.columns import Columns
from gfm_hil.recording.live import LiveRun
from gfm_hil.recording.log import read_events, read_summary
from gfm_hil.recording.run import Run, nominal_frequency, read_scenario
from gfm_hil.scenario import Scenario
from gfm_runtime import LawError, law_titles, load_law

Law = dict[str, str]  #: label and name of a law, and in words its changes against its file

_BEHIND = 2000  # ticks: wait for the side that is behind, up to this lag


@dataclass
class Recording:
    """Rows of a run as columns by name, and what is known about the run."""

    folder: Path
    scenario: Scenario  # the resolved one; a run can be shown without its law files
    columns: Columns = field(default_factory=dict)  # all rows recorded so far
    # the laws by the indices in column ``law``, see ``_law``
    laws: list[Law] = field(default_factory=list)
    live: bool = True  # the run may still be in progress

    def __post_init__(self) -> None:
        self.T_s, self.capacity = self.scenario.T_s, self.scenario.ticks
        self._run = LiveRun(self.folder)
        self._done = 0
        self._met = False  # whether the run's command servers have been seen

    @property
    def f_b(self) -> float:
        """Base frequency, Hz. Raises UserError: the scenario's converter cannot be loaded."""
        return nominal_frequency(self.scenario)

    def done(self) -> int:
        """Number of ticks that can be read; also opens the parts of a run that has just begun."""
        if not self.live:
            return self._done
        self.columns = self._run.columns
        counts = [self._run.done(role) for role in self._run.parts]
        if counts:  # rows of both sides, unless one has none or has stopped recording
            least, most = min(counts), max(counts)
            self._done = max(self._done, least if most - least < _BEHIND else most - _BEHIND)
        return self._done

    def finish(self) -> None:
        """Note that the run is over: nothing is appended any more."""
        self.columns = self._run.columns
        self._done = max([self._done, *(self._run.done(role) for role in self._run.parts)])
        self.live = False

    def look_up_laws(self) -> None:
        """Read the laws behind the indices in column ``law`` again: gains may have changed."""
        server = read_announcement(self.folder, "controller")
        if server is None:  # a foreign controller, or it has ended
            return
        self.laws = [_law(law["label"], law["title"], law["gains"]) for law in server["laws"]]

    def events(self) -> list[dict[str, Any]]:
        """The events so far, in order of time."""
        return read_events(self.folder, self.capacity)

    def ended(self) -> dict[str, str] | None:
        """How the run ended, ``status`` and ``reason``; None while it is in progress. Raises
        UserError: the summary cannot be read, or it is unknown whether the run is still in
        progress."""
        try:
            content = read_summary(self.folder, self.capacity)
        except FileNotFoundError:  # without one it is over once its command servers have gone
            there = bool(running_roles(self.folder))
            self._met |= there
            return {"status": "over", "reason": ""} if self._met and not there else None
        return {key: str(content[key]) for key in ("status", "reason")}


def open_recording(folder: Path) -> Recording:
    """The recording in a run folder. Raises UserError: it is not a run folder, or has no
    recording."""
    scenario = read_scenario(folder)
    if (folder / "summary.json").is_file():
        run = Run.load(folder)
        laws = [_law(label) for label in run.laws]
        record = Recording(folder, scenario, run.recorded, laws, live=False)
        record._done = record.capacity = run.ticks
        return record
    if not has_recording(folder):
        raise UserError(f"{folder}: nothing has been recorded there")
    return Recording(folder, scenario, laws=_laws(scenario))


def _laws(scenario: Scenario) -> list[Law]:
    """The laws as the controller numbers them: each stage of a scheduled law has a number."""
    laws: list[Law] = []
    for name, title in law_titles(scenario.laws()).items():
        try:
            stages = len(load_law(name).laws)
        except LawError as problem:
            raise UserError(str(problem)) from None
        laws += [_law(title)] if stages == 1 else [_law(f"{title}[{k}]") for k in range(stages)]
    return laws


def _law(label: str, name: str = "", gains: dict[str, float] | None = None) -> Law:
    changed = ", ".join(f"{key} = {value:g}" for key, value in (gains or {}).items())
    name = name or label.partition("[")[0]
    return {"label": name if changed else label, "name": name, "gains": changed}
