"""The recording behind a scope: of a run in progress or of a finished one."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.engine.announcement import announced, present
from gfm_hil.recording.log import read_log, read_summary
from gfm_hil.recording.recorder import (
    CONTROLLER_COLUMNS,
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
    Part,
    read_recording,
)
from gfm_hil.scenario.model import Scenario
from gfm_hil.scope.channels import Columns
from gfm_plant import load_converter
from gfm_runtime import LawError, load_law

Law = dict[str, str]  #: label and name of a law, and in words its changes against its file

_BEHIND = 2000  # ticks: wait for the side that is behind, up to this lag
_COLUMNS = {"plant": PLANT_COLUMNS, "controller": CONTROLLER_COLUMNS}
_TIMES = {"plant": PLANT_TIMES, "controller": CONTROLLER_TIMES}


@dataclass
class Record:
    """Rows of a run as columns by name, and what is known about the run.

    Attributes:
        folder: of the run.
        scenario: the resolved one; plain data, so that a run can be shown without its law files.
        columns: all rows recorded so far.
        laws: the laws by the indices in column ``law``, see ``_law``.
        live: the run may still be in progress.
    """

    folder: Path
    scenario: dict[str, Any]
    columns: Columns = field(default_factory=dict)
    laws: list[Law] = field(default_factory=list)
    live: bool = True

    def __post_init__(self) -> None:
        self.T_s = float(self.scenario["T_s"])
        self.capacity = round(self.scenario["duration"] / self.T_s)
        self._parts: dict[str, Part] = {}
        self._done = 0
        self._met = False  # whether the run's desks have been seen

    @property
    def f_b(self) -> float:
        """Base frequency, Hz.

        Raises:
            UserError: the scenario's converter cannot be loaded.
        """
        name = self.scenario["plant"]["converter"]
        try:
            return load_converter(name).bases.omega_b / (2 * math.pi)
        except (OSError, ValueError) as problem:
            raise UserError(f"plant.converter = {name!r}: {problem}") from None

    def done(self) -> int:
        """Number of ticks that can be read; also opens the parts of a run that has just begun."""
        if not self.live:
            return self._done
        for side in ("plant", "controller"):
            if side not in self._parts and (part := Part.open(self.folder, side)) is not None:
                self._parts[side] = part
                self.columns = {**self.columns, **_columns(side, part)}
        counts = [int(part.progress[0]) for part in self._parts.values()]
        if counts:  # rows of both sides, unless one has none or has stopped recording
            least, most = min(counts), max(counts)
            self._done = max(self._done, least if most - least < _BEHIND else most - _BEHIND)
        return self._done

    def finish(self) -> None:
        """Note that the run is over: nothing is appended any more."""
        counts = [int(part.progress[0]) for part in self._parts.values()]
        self._done, self.live = max([self._done, *counts]), False

    def look_up_laws(self) -> None:
        """Read the laws behind the indices in column ``law`` again: gains may have changed."""
        desk = announced(self.folder, "controller")
        if desk is None:  # a foreign controller, or it has ended
            return
        self.laws = [_law(law["label"], law["name"], law["gains"]) for law in desk["laws"]]

    def events(self) -> list[dict[str, Any]]:
        """The events so far, in order of time."""
        whole = self.folder / "events.jsonl"
        return read_log(whole) if whole.is_file() else read_log(*self.folder.glob("events_*.jsonl"))

    def ended(self) -> dict[str, str] | None:
        """How the run ended, ``status`` and ``reason``; None while it is in progress.

        Raises:
            OSError: the summary cannot be read.
            UserError: it is unknown whether the run is still in progress.
        """
        try:
            content = read_summary(self.folder)
        except FileNotFoundError:
            return self._gone()
        return {key: str(content[key]) for key in ("status", "reason")}

    def _gone(self) -> dict[str, str] | None:
        """The end of a run without a summary: its desks were seen and exist no more."""
        there = bool(present(self.folder))
        self._met |= there
        if self._met and not there:
            return {"status": "over", "reason": ""}
        return None


def begun(folder: Path) -> bool:
    """Whether there is a recording: of a run that has begun to record, or of a finished one."""
    return (folder / "signals.npz").is_file() or any(
        (folder / "parts" / f"{side}_progress.npy").is_file() for side in _COLUMNS
    )


def open_record(folder: Path) -> Record:
    """The recording in a run folder.

    Raises:
        UserError: it is not a run folder, or has no recording.
    """
    scenario = _resolved(folder)
    if (folder / "summary.json").is_file():
        return _finished(folder, scenario)
    if not begun(folder):
        raise UserError(f"{folder}: nothing has been recorded there")
    return Record(folder, scenario, laws=_laws(scenario))


def _resolved(folder: Path) -> dict[str, Any]:
    """The scenario of a run as plain data with all defaults; its law files may be gone."""
    try:
        content = tomllib.loads((folder / "scenario.toml").read_text("utf-8"))
        return Scenario.model_validate(content).model_dump(mode="json", exclude_none=True)
    except ValidationError as problem:
        reason = "; ".join(lines(problem))
    except RecursionError:
        reason = "nested too deeply"
    except (OSError, ValueError) as problem:
        reason = getattr(problem, "strerror", None) or str(problem)
    raise UserError(f"{folder}: not a run folder: scenario.toml: {reason}")


def _finished(folder: Path, scenario: dict[str, Any]) -> Record:
    try:
        signals, timing, laws = read_recording(folder)
    except OSError as problem:
        raise UserError(f"{folder}: signals.npz or timing.npz cannot be read: {problem}") from None
    columns = {**signals, **timing}
    record = Record(folder, scenario, columns, [_law(label) for label in laws], live=False)
    record._done = record.capacity = len(columns["tick"])
    return record


def _columns(side: str, part: Part) -> dict[str, NDArray[Any]]:
    """Columns of a side under their names in signals.npz and timing.npz."""
    signals, times = np.asarray(part.signals), np.asarray(part.times)
    found = {name: signals[:, j] for j, name in enumerate(_COLUMNS[side])}
    return found | {f"{side}_{name}": times[:, j] for j, name in enumerate(_TIMES[side])}


def ready(scenario: dict[str, Any]) -> list[str]:
    """Names of the laws that a run can switch to; its first law comes first."""
    changes = [e["law"] for e in scenario.get("events", []) if e["type"] == "law"]
    return list(dict.fromkeys([scenario["law"], *changes, *scenario.get("ready_laws", [])]))


def _laws(scenario: dict[str, Any]) -> list[Law]:
    """The laws as the controller numbers them: each stage of a scheduled law has a number."""
    laws: list[Law] = []
    for name in ready(scenario):
        try:
            stages = len(load_law(name).laws)
        except LawError as problem:
            raise UserError(str(problem)) from None
        laws += [_law(name)] if stages == 1 else [_law(f"{name}[{k}]") for k in range(stages)]
    return laws


def _law(label: str, name: str = "", gains: dict[str, float] | None = None) -> Law:
    changed = ", ".join(f"{key} = {value:g}" for key, value in (gains or {}).items())
    name = name or label.partition("[")[0]
    return {"label": name if changed else label, "name": name, "gains": changed}
