"""Follows the recording of a run in progress, row by row, from now on."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import SIDES, Side
from gfm_hil.recording.recorder import (
    CONTROLLER_COLUMNS,
    CONTROLLER_TIMES,
    PLANT_COLUMNS,
    PLANT_TIMES,
    Part,
)

COLUMNS = {"plant": PLANT_COLUMNS, "controller": CONTROLLER_COLUMNS}
TIMES = {"plant": PLANT_TIMES, "controller": CONTROLLER_TIMES}

_LAST = 1  # newest rows not read yet: a tick's last time is written after it counts as done


@dataclass(frozen=True)
class Rows:
    """Rows of one side, as in ``recording.Part``.

    Attributes:
        side: ``"plant"`` or ``"controller"``.
        first: tick of the first row.
        signals: shape (n, columns), the units of the recording; NaN in ticks never recorded.
        times: shape (n, columns), int64, ns.
    """

    side: Side
    first: int
    signals: NDArray[np.float64]
    times: NDArray[np.int64]

    def time(self, name: str) -> NDArray[np.int64]:
        """A column of ``times`` by name."""
        return self.times[:, TIMES[self.side].index(name)]


class Follower:
    """Reads the growing parts of a run.

    Args:
        folder: of a run that has begun.

    Raises:
        UserError: it is not a run folder, or the run is over.
    """

    def __init__(self, folder: Path) -> None:
        if (folder / "summary.json").is_file():
            raise UserError(f"{folder}: the run is over, see gfmhil export")
        if not begun(folder):
            raise UserError(f"{folder}: no run is going on there; --wait waits for one")
        try:
            T_s = tomllib.loads((folder / "scenario.toml").read_text(encoding="utf-8"))["T_s"]
            if not isinstance(T_s, float) or not 0 < T_s < math.inf:
                raise ValueError(f"T_s = {T_s!r}: must be a number of seconds")
        except (OSError, ValueError, KeyError, RecursionError) as problem:
            raise UserError(f"{folder}: scenario.toml: {problem}") from None
        self.folder, self.T_s = folder, T_s
        self.parts: dict[Side, Part] = {}
        self._next: dict[Side, int] = {}
        self.over = False
        self._find(from_now=True)

    def _find(self, from_now: bool) -> None:
        for side in SIDES:
            if side not in self.parts and (part := Part.open(self.folder, side)) is not None:
                self.parts[side] = part
                self._next[side] = int(part.progress[0]) if from_now else 0

    def news(self) -> list[Rows]:
        """Rows recorded since the last call that returned; afterwards ``over`` says whether these
        were the last.

        Raises:
            OSError: the recording cannot be read now; the next call returns its rows.
        """
        over = not (self.folder / "parts").is_dir()  # the parts were merged and removed
        self._find(from_now=False)
        found = []
        for side, part in self.parts.items():
            first, done = self._next[side], int(part.progress[0]) - (0 if over else _LAST)
            if done > first:
                rows = slice(first, done)
                signals, times = np.asarray(part.signals[rows]), np.asarray(part.times[rows])
                found.append(Rows(side, first, signals, times))
        self.over = over
        self._next |= {rows.side: rows.first + len(rows.signals) for rows in found}
        return found

    def misses_before(self) -> int:
        """Number of misses before the rows that the next call of ``news`` returns."""
        part = self.parts.get("plant")
        if part is None:
            return 0
        times = np.asarray(part.times[: self._next["plant"]])
        return int(missed(Rows("plant", 0, part.signals[:0], times)).sum())


def missed(rows: Rows) -> NDArray[np.bool_]:
    """Which of the plant's rows, in real time, got no u in time."""
    return (rows.time("scheduled") >= 0) & (rows.time("received") < 0)


def slack_us(rows: Rows, T_s: float) -> NDArray[np.float64]:
    """Time left between the arrival of u[k] at the plant and the next deadline, µs.

    NaN if there is no deadline or u was late.
    """
    due, received = rows.time("scheduled"), rows.time("received")
    left = (due + round(T_s * 1e9) - received) * 1e-3
    return np.where((due >= 0) & (received >= 0), left, np.nan)


def begun(folder: Path) -> bool:
    """Whether the run has begun to record and its scenario is written."""
    recorded = any((folder / f"parts/{side}_progress.npy").is_file() for side in SIDES)
    return recorded and (folder / "scenario.toml").is_file()
