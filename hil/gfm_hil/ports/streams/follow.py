"""Follows the recording of a run in progress, row by row, from now on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.announcement import not_running
from gfm_hil.recording.columns import Columns, named
from gfm_hil.recording.live import LiveRun, begun
from gfm_hil.recording.timing import count_misses

_LAST = 1  # newest rows not read yet: a tick's last time is written after it counts as done


@dataclass(frozen=True)
class NewRows:
    """Rows of one side, as in ``recording.parts.RolePart``.

    Attributes:
        role: ``"plant"`` or ``"controller"``.
        first: tick of the first row.
        signals: shape (n, columns), the units of the recording; NaN in ticks never recorded.
        times: shape (n, columns), int64, ns.
    """

    role: Role
    first: int
    signals: NDArray[np.float64]
    times: NDArray[np.int64]

    @property
    def columns(self) -> Columns:
        """The same by the names of the columns in a run folder."""
        return named(self.role, self.signals, self.times)


class Follower:
    """Reads what a run records from now on.

    Attributes:
        run: all that it has recorded.
        over: nothing will be recorded any more.

    Raises:
        UserError: it is not a run folder, or the run is over.
    """

    def __init__(self, folder: Path) -> None:
        if (folder / "summary.json").is_file():
            raise UserError(f"{folder}: the run is over, see gfmhil export")
        if not begun(folder):
            raise UserError(f"{not_running(folder)}; --wait waits for one")
        self.folder, self.run = folder, LiveRun(folder)
        self.T_s = self.run.T_s
        self._next = {role: self.run.done(role) for role in ROLES}
        self.over = False

    def news(self) -> list[NewRows]:
        """Rows recorded since the last call that returned; afterwards ``over`` says whether these
        were the last.

        Raises:
            OSError: the recording cannot be read now; the next call returns its rows.
        """
        over = not (self.folder / "parts").is_dir()  # the parts were merged and removed
        found = []
        for role, part in self.run.parts.items():
            first, done = self._next[role], self.run.done(role) - (0 if over else _LAST)
            if done > first:
                found.append(NewRows(role, first, part.signals[first:done], part.times[first:done]))
        self.over = over
        self._next |= {rows.role: rows.first + len(rows.signals) for rows in found}
        return found

    def misses_before(self) -> int:
        """Number of misses before the rows that the next call of ``news`` returns."""
        return count_misses(self.run.columns, self._next["plant"])
