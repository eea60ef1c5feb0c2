"""A finished run as one table: every tick a row, every column described."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.recording.log import read_log, read_summary
from gfm_hil.recording.npz import Column
from gfm_hil.recording.recorder import read_recording
from gfm_hil.results.export.columns import Described, describe


@dataclass(frozen=True)
class RunTable:
    """What a run folder holds, for writers of files.

    Attributes:
        folder: of the run.
        columns: described, in the order of ``values``.
        values: by name, each shape (ticks,): float64 in the unit of its column, or int64; a slice
            of one is read from the file, and nothing more.
        laws: labels of the laws, which the column ``law`` refers to.
        events: lines of events.jsonl.
        summary: content of summary.json.
    """

    folder: Path
    columns: list[Described]
    values: dict[str, Column]
    laws: list[str]
    events: list[dict[str, Any]]
    summary: dict[str, Any]

    @property
    def ticks(self) -> int:
        """Rows of the table."""
        return len(self.values["tick"])

    def blocks(self, ticks: int) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Rows in blocks of at most ``ticks``: the first tick, and all columns from there on."""
        for first in range(0, self.ticks, ticks):
            yield first, {name: x[first : first + ticks] for name, x in self.values.items()}

    def text(self, name: str) -> str:
        """A text file of the run folder."""
        return (self.folder / name).read_text(encoding="utf-8")


def load_run(folder: Path) -> RunTable:
    """The table of a finished run.

    Raises:
        UserError: it is no run folder, or the run is not over.
    """
    try:
        signals, timing, laws = read_recording(folder)
        summary = read_summary(folder)
    except FileNotFoundError as problem:
        going = (folder / "scenario.toml").is_file()
        what = "the run is not over, see gfmhil stream, or was cut off, see gfmhil recover"
        what = what if going else "is not a run folder"
        raise UserError(f"{folder}: {what} ({Path(problem.filename).name} is missing)") from None
    except (OSError, ValueError) as problem:
        raise UserError(f"{folder}: {problem}") from None
    values = {**signals, **timing}
    columns = [describe(name, laws) for name in values]
    log = read_log(folder / "events.jsonl")
    return RunTable(folder, columns, values, laws, log, summary)


def event_text(event: dict[str, Any]) -> str:
    """What a line of the log says beyond its kind, in a few words."""
    if "label" in event:
        return str(event["label"])
    rest = {k: v for k, v in event.items() if k not in ("tick", "t", "event")}
    return ", ".join(f"{key} {value}" for key, value in rest.items())
