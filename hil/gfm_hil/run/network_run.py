"""A finished run of several converters in one network: a run for each, with what they share."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import check_empty, write_text
from gfm_hil.recording.columns import Columns
from gfm_hil.recording.run import Run, Signals, nominal_frequency, read_scenario
from gfm_hil.run.run_folder import Report, merge_roles, recover, save
from gfm_hil.scenario import Scenario, write_scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, repr=False)
class NetworkRun(Mapping[str, Run]):
    """The runs of a network's converters, by their names."""

    scenario: Scenario  # of the whole network
    runs: dict[str, Run]  # of each converter, in the order of the scenario
    # which has a run folder for each, by its name; None for a run in memory
    folder: Path | None = None

    if TYPE_CHECKING:  # functions of rooms further up, which ``gfm_hil.api.runs`` adds
        plot: ClassVar[Callable[..., list[Axes]]]
        save: ClassVar[Callable[..., Path]]

    def __getitem__(self, converter: str) -> Run:
        if converter not in self.runs:
            raise KeyError(f"{converter!r}: must be one of {', '.join(self.runs)}")
        return self.runs[converter]

    def __iter__(self) -> Iterator[str]:
        return iter(self.runs)

    def __len__(self) -> int:
        return len(self.runs)

    @property
    def status(self) -> str:
        """How the runs ended, in one word if they agree."""
        found = {name: run.status for name, run in self.runs.items()}
        if len(set(found.values())) == 1:
            return next(iter(found.values()))
        return ", ".join(f"{name} {status}" for name, status in found.items())

    @property
    def summary(self) -> dict[str, Any]:
        """The summary of each run, and what is not as expected in any."""
        return {
            "title": self.scenario.title,
            "status": self.status,
            "stopped": any(run.summary.get("stopped", False) for run in self.values()),
            "unmet": [f"{n}: {part}" for n, run in self.items() for part in run.summary["unmet"]],
            "converters": {name: run.summary for name, run in self.items()},
        }

    @property
    def metrics(self) -> dict[str, dict[str, dict[str, Any]]]:
        """The metrics of each run by converter, see ``Run.metrics``."""
        return {name: run.metrics for name, run in self.items()}

    def conclude(self, folder: Path, report: Report | None = None) -> Self:
        """Write what the runs share into a folder that has theirs and the scenario; returns this.
        Raises UserError: the folder cannot be written."""
        with naming(folder):
            if report is not None and any(run.ticks for run in self.values()):
                report(replace(self, folder=folder))
            write_text(folder / "summary.json", json.dumps(self.summary, indent=2) + "\n")
        return self

    @classmethod
    def recover(cls, folder: Path, report: Report | None = None) -> NetworkRun:
        """Complete the folder of a network whose run was cut off, converter by converter. Raises
        UserError, Unfinished: as ``run_folder.recover``."""
        scenario = read_scenario(folder)
        runs = {name: recover(place, report) for name, place in _places(folder, scenario).items()}
        return cls(scenario, runs, folder).conclude(folder, report)

    @classmethod
    def merge(
        cls, plant: Path, controllers: Sequence[Path], folder: Path, report: Report | None = None
    ) -> NetworkRun:
        """One folder of a network from that of its plant and those of its controllers, which were
        started separately. Raises UserError: they are not one folder for each converter, or as
        ``run_folder.merge_roles``."""
        scenario = read_scenario(plant)
        places = _places(plant, scenario)
        check_empty(folder)
        of: dict[str | None, Path] = {}
        for place in controllers:
            name = read_scenario(place).converter
            if name not in places or name in of:
                again = f"as {of[name]} has" if name in of else f"none of {[*places]}"
                raise UserError(f"{place}: has the controller of {name}, {again}")
            of[name] = place
        if missing := [name for name in places if name not in of]:
            raise UserError(f"{plant}: the folder of the controller of {missing[0]} is missing")
        runs = {
            name: merge_roles(place, of[name], folder / name, report)
            for name, place in places.items()
        }
        with naming(folder):
            write_scenario(folder, scenario)
        return cls(scenario, runs, folder).conclude(folder, report)

    @classmethod
    def load(cls, folder: str | Path) -> NetworkRun:
        """The runs of a folder that ``save`` or ``gfmhil run`` has written. Raises UserError: it is
        none."""
        folder = Path(folder)
        scenario = read_scenario(folder)
        if not scenario.parts:
            raise UserError(f"{folder}: is not the folder of a network")
        runs = {name: Run.load(place) for name, place in _places(folder, scenario).items()}
        return cls(scenario, runs, folder)

    @property
    def columns(self) -> dict[str, Columns]:
        """The columns of each run."""
        return {name: run.columns for name, run in self.items()}

    @property
    def flows(self) -> Signals:
        """What was recorded of the network itself, see ``network.record``, by names such as
        ``feeder.P``, and ``t``, s; p.u. of the first converter."""
        columns = next(iter(self.values())).columns
        there = [name for name in ("t", *self.scenario.flows) if name in columns]
        return Signals({name: columns[name] for name in there}, nominal_frequency(self.scenario))

    @property
    def events(self) -> list[dict[str, Any]]:
        """What happened, of each converter and once for what they all saw."""
        found: dict[tuple[int, str], dict[str, Any]] = {}
        for run in self.values():
            for event in run.summary["events"]:
                found.setdefault((event["tick"], event["label"]), event)
        return [found[key] for key in sorted(found)]

    def __repr__(self) -> str:
        lines = [f"  {name}: {run.status}" for name, run in self.items()]
        return "\n".join(["<NetworkRun", *lines, ">"])


def _places(folder: Path, scenario: Scenario) -> dict[str, Path]:
    """The run folders of a network's converters in its own folder, by their names. Raises
    UserError: one is a link."""
    places = {name: folder / name for name in scenario.parts}
    for name, place in places.items():
        if place.is_symlink() or place.parent != folder or name == "..":
            raise UserError(f"{place}: is not a folder in {folder}")
    return places


def save_network(run: NetworkRun, folder: str | Path, report: Report | None = None) -> Path:
    """Write a folder with the run folder of each converter, and a figure of all; returns it. Raises
    UserError: the folder holds something already, or cannot be written."""
    folder = Path(folder)
    check_empty(folder)
    for name, one in run.items():
        save(one, folder / name, report)
    with naming(folder):
        write_scenario(folder, run.scenario)
    run.conclude(folder, report)
    return folder
