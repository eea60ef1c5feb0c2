"""Curves in a page that a reader can zoom: few points that lie close to all ticks, packed."""

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import ColumnLike, pieces

Vector = NDArray[np.float64]
POINTS = 16_000  # most of a panel
_NEAR = 5e-4  # of the height of its curve: how close the straight lines between points come
_LEVELS = 4094  # steps of a quarter of a thousandth of a curve's height
_NO_VALUE = 0xFFFF
_PIECE = 1 << 16  # ticks whose points are chosen together; all arrays for it take some 5 MB


@dataclass(frozen=True)
class Panel:
    """A quantity over time or frequency."""

    title: str  # quantity and unit
    x: Vector  # s or Hz, ascending, shape (K,)
    curves: Mapping[str, Vector]  # by label, shape (K,) each; NaN where there is no value
    ends: tuple[float, float]  # of the axis
    events: Sequence[tuple[float, str]] = ()  # s, and what happens
    marks: Sequence[Any] = ()  # with ``number``, ``colour``, ``window`` and ``lines``
    colours: Sequence[str] = ()  # of the curves; by default those of the page
    over: str = "t [s]"  # the abscissa
    log: tuple[bool, bool] = (False, False)  # whether abscissa and ordinate are logarithmic
    bands: Sequence[tuple[float, float]] = field(default=())  # shaded, from when to when, s
    dots: bool = False  # points without lines; those of a curve ``run`` are values alone


def decimated_ticks(columns: Sequence[ColumnLike], most: int = POINTS) -> NDArray[np.intp]:
    """Ticks between which straight lines follow all columns of a panel.

    Half of them at most are the least and the largest value of stretches of the same length, so
    that no oscillation is lost. Then each line is split where it misses a curve most, all lines in
    turn, until none misses by ``_NEAR`` of the curve's height or there are ``most`` ticks.

    Args:
        columns: of the same length, read a piece at a time; NaN counts as 0. Each piece has its
            share of the ticks.
    """
    ticks = len(columns[0])
    heights = np.array([_height(column) for column in columns])[:, None]
    found = [np.zeros(0, np.intp)]
    for first in range(0, ticks, _PIECE):
        piece = np.stack([column[first : first + _PIECE] for column in columns], dtype=float)
        found.append(first + _split(piece, heights, most / ticks))
    return np.concatenate(found)


def _height(column: ColumnLike) -> float:
    low, high = np.inf, -np.inf
    for part in pieces(column, 0, len(column)):
        known = part[np.isfinite(part)]
        if len(known):
            low, high = min(low, float(known.min())), max(high, float(known.max()))
    return high - low if high > low else 1.0


def _split(piece: NDArray[Any], heights: NDArray[Any], share: float) -> NDArray[np.intp]:
    """``decimated_ticks`` of a piece, shape (curves, ticks), which it divides by the heights."""
    piece /= heights
    np.nan_to_num(piece, copy=False, posinf=0.0, neginf=0.0)
    every = np.arange(piece.shape[1], dtype=float)
    most = max(2, round(share * len(every)))
    stretch = -(-4 * len(piece) * len(every) // most)
    ends = [np.array([0, len(every) - 1])]
    for curve in piece:
        stretches = np.pad(curve, (0, -len(curve) % stretch), "edge").reshape(-1, stretch)
        starts = np.arange(len(stretches)) * stretch
        ends += [starts + stretches.argmin(axis=1), starts + stretches.argmax(axis=1)]
    kept = np.unique(np.concatenate(ends))
    while len(kept) > 1:
        missed = np.zeros(len(every))
        for curve in piece:
            line = np.interp(every, kept, curve[kept])
            np.maximum(missed, np.abs(np.subtract(curve, line, out=line), out=line), out=missed)
        worst = np.repeat(np.maximum.reduceat(missed[:-1], kept[:-1]), np.diff(kept))
        at = np.flatnonzero((missed[:-1] == worst) & (worst > _NEAR))
        at = at[np.unique(np.searchsorted(kept, at, "right"), return_index=True)[1]]
        room = most - len(kept)
        if not len(at) or room <= 0:
            break
        at = at[np.argsort(-missed[at])[:room]]
        kept = np.sort(np.concatenate([kept, at]))
    return kept


class PackedCurves:
    """The curves of all panels of a page: in levels of their own height, each as what it changes
    from point to point, compressed together."""

    def __init__(self) -> None:
        self.plots = list[dict[str, Any]]()  # one a panel, for the page's script
        self._parts, self._count = list[bytes](), 0

    def add(self, panel: Panel) -> int:
        """Take a panel; returns its number in the page."""
        limits = [
            [*(np.char.mod("%.5g", z).astype(float).tolist() for z in line), m.colour, m.number]
            for m in panel.marks
            for line in m.lines
        ]
        bars = [
            [*m.window, m.colour, m.number]
            for m in panel.marks
            if not m.lines and m.window[1] > m.window[0]
        ]
        as_they_are = "colours", "bands", "events", "ends", "over", "log", "dots"
        self.plots.append(
            {
                "x": self._abscissa(panel.x),
                "curves": [[label, *self._pack(y)] for label, y in panel.curves.items()],
                "limits": limits,
                "bars": bars,
                **{name: getattr(panel, name) for name in as_they_are},
            }
        )
        return len(self.plots) - 1

    def _abscissa(self, x: Vector) -> list[float]:
        """Where it begins, how many points it has, the first, and the step: whole steps between
        two points if they are ticks, else levels as of a curve."""
        steps = np.diff(x, prepend=x[:1])
        step = float(steps[steps > 0].min(initial=np.inf))
        whole = np.rint(steps / step)
        if step == np.inf or (np.abs(steps / step - whole) > 1e-3).any() or whole.max() > 0xFFFF:
            return self._pack(x)
        step = float(x[-1] - x[0]) / float(whole.sum())
        self._put(whole)
        return [self._count - len(x), len(x), float(x[0]), step, 1]

    def _pack(self, x: Vector) -> list[float]:
        """Where its levels begin, how many there are, and what the least and the largest mean."""
        known = x[np.isfinite(x)]
        low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
        level = np.full(len(x), _NO_VALUE)
        level[np.isfinite(x)] = np.rint((known - low) / ((high - low) or 1.0) * _LEVELS)
        self._put(np.diff(level, prepend=0) & 0xFFFF)
        return [self._count - len(x), len(x), float(f"{low:.6g}"), float(f"{high:.6g}")]

    def _put(self, words: NDArray[Any]) -> None:
        self._parts.append(words.astype("<u2").tobytes())
        self._count += len(words)

    def text(self) -> str:
        """All levels, little-endian, as zlib compresses them, in base 64."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 9)).decode()
