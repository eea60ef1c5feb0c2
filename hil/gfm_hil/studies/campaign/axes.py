"""The numbers of one axis: a drawn path, or the sum of several ("a + b")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.studies.campaign.draw import Choice, LogUniform
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Record


@dataclass(frozen=True)
class Axis:
    """One axis of the figure."""

    name: str  # the path or sum, as given
    label: str  # what is written at the axis
    log: bool = False  # drawn over a logarithm
    # the values where they are not numbers; the axis counts them from 0
    words: tuple[str, ...] = ()
    # how far a value may be shifted aside so that equal ones do not hide each other
    apart: float = 0.0

    def values(self, records: Sequence[Record]) -> NDArray[np.float64]:
        """The value of every record, shape (n,)."""
        if self.words:
            found = [self.words.index(str(r["drawn"][self.name])) for r in records]
            return np.array(found, dtype=float)
        return np.array([self._sum(r["drawn"]) for r in records], dtype=float)

    def shown(self, drawn: dict[str, Any]) -> str:
        """The value of one run in words."""
        return str(drawn[self.name]) if self.words else f"{self._sum(drawn):.4g}"

    def _sum(self, drawn: dict[str, Any]) -> float:
        return float(sum(drawn[part.strip()] for part in self.name.split("+")))


def find_axes(campaign: Campaign, x: str | None, y: str | None) -> tuple[Axis, Axis | None]:
    """The axes asked for, those of the file, or the first two drawn; no second if only one is.

    Raises:
        UserError: a path that is not drawn, the same twice, words in a sum.
    """
    drawn = [d.path for d in campaign.file.draw]
    x = x or campaign.file.figure.x or next(p for p in drawn if p != y)
    y = y or campaign.file.figure.y or next((p for p in drawn if p != x), None)
    if x == y:
        raise UserError(f"--x, --y: both are {x!r}; choose two of {drawn}")
    return _axis(campaign, "--x", x), None if y is None else _axis(campaign, "--y", y)


def _axis(campaign: Campaign, option: str, name: str) -> Axis:
    drawn = {d.path: d for d in campaign.file.draw}
    parts = [part.strip() for part in name.split("+")]
    for part in parts:
        if part not in drawn:
            raise UserError(f"{option} {name!r}: {part!r} is not drawn; drawn are {list(drawn)}")
    mine = [drawn[part] for part in parts]
    label = " + ".join(d.label or d.path for d in mine)
    if len(mine) > 1:
        if any(_words(d) for d in mine):
            raise UserError(f"{option} {name!r}: only numbers have a sum")
        return Axis(name, label)
    only: Any = mine[0]
    if isinstance(only, Choice):
        words = _words(only)
        steps = np.diff(np.arange(len(words)) if words else np.unique(np.array(only.values, float)))
        return Axis(name, label, words=words, apart=0.3 * float(min(steps, default=1.0)))
    return Axis(name, label, log=isinstance(only, LogUniform))


def _words(d: Any) -> tuple[str, ...]:
    if not isinstance(d, Choice):
        return ()
    if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in d.values):
        return ()
    return tuple(dict.fromkeys(map(str, d.values)))
