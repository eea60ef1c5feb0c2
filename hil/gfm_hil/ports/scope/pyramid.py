"""Minima and maxima of every channel over blocks of ticks of increasing length.

A decimated plot must not miss a peak. Level l holds the extremes of blocks of 8^l ticks, computed
once as ticks arrive; level 0 is the recording itself. A window of any length is read from the
coarsest level that resolves it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_hil.ports.scope.channels import ScopeChannel
from gfm_hil.ports.scope.recording import Recording

STEP = 8  # blocks of one level in one block of the next
_AT_ONCE = STEP**5  # most ticks processed per update

Extremes = NDArray[np.float32]


class Pyramid:
    """The extremes of a recording."""

    def __init__(self, record: Recording, channels: Sequence[ScopeChannel]) -> None:
        self.record, self.channels = record, tuple(channels)
        self._index = {channel.name: k for k, channel in enumerate(self.channels)}
        self._levels: list[tuple[Extremes, Extremes]] = []
        self._full: list[int] = []  # blocks done, by level
        size = record.capacity // STEP
        while size:  # untouched memory is not allocated
            shape = (len(self.channels), size)
            self._levels.append((np.empty(shape, np.float32), np.empty(shape, np.float32)))
            self._full.append(0)
            size //= STEP
        self._missed = np.empty(0, np.int64)  # ticks
        self.done = 0

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def values(self, name: str, first: int, last: int) -> NDArray[np.float32]:
        """A channel at every tick of [first, last)."""
        return self.channels[self._index[name]].read(self.record.columns, first, last)

    def misses(self, before: int) -> int:
        """Number of ticks before ``before`` that had no fresh u."""
        return int(np.searchsorted(self._missed, before))

    def update(self) -> bool:
        """Process ticks recorded since the last call; False if more are left."""
        there = self.record.done()
        self.done = min(there, self.done + _AT_ONCE)
        if self._levels:
            self._take_in()
        return self.done == there

    def _take_in(self) -> None:
        first, last = self._full[0] * STEP, self.done // STEP * STEP
        if first == last:
            return
        rows = np.stack([c.read(self.record.columns, first, last) for c in self.channels])
        missed = first + np.flatnonzero(rows[self._index["miss"]] == 1.0)
        if len(missed):
            self._missed = np.concatenate([self._missed, missed])
        low = high = rows
        for level, (lows, highs) in enumerate(self._levels):
            if level:
                below = self._levels[level - 1]
                a, b = self._full[level] * STEP, self._full[level - 1] // STEP * STEP
                low, high = below[0][:, a:b], below[1][:, a:b]
            if not low.shape[1]:
                return
            start, n = self._full[level], low.shape[1] // STEP
            shape = (len(self.channels), n, STEP)
            lows[:, start : start + n] = np.fmin.reduce(low.reshape(shape), axis=2)
            highs[:, start : start + n] = np.fmax.reduce(high.reshape(shape), axis=2)
            self._full[level] += n

    def width(self, ticks: int, bins: int) -> int:
        """Ticks per bin so that ``ticks`` give at least ``bins`` bins, if there are enough."""
        width = max(1, ticks // bins)
        level = STEP ** min(len(self._levels), int(np.log(width) / np.log(STEP) + 1e-9))
        return width // level * level

    def bins(self, name: str, first: int, last: int, width: int) -> tuple[Extremes, Extremes]:
        """Extremes over bins first … last-1 of ``width`` ticks each, bin k from tick k·width.

        The last bin may be incomplete; it must not be empty.
        """
        channel, level, unit = self._index[name], -1, 1
        while width % (unit * STEP) == 0 and level + 1 < len(self._levels):
            level, unit = level + 1, unit * STEP
        each = width // unit
        end = self.done if level < 0 else self._full[level] * unit
        whole = max(first, min(last, end // width))  # bins before it are complete on this level
        if level < 0:
            low = high = self.values(name, first * width, whole * width)
        else:
            low, high = (e[channel, first * each : whole * each] for e in self._levels[level])
        lows = np.fmin.reduce(low.reshape(-1, each), axis=1)
        highs = np.fmax.reduce(high.reshape(-1, each), axis=1)
        rest = [
            self._extremes(channel, k * width, min(self.done, (k + 1) * width), level)
            for k in range(whole, last)
        ]
        if rest:
            lows = np.append(lows, [low for low, _ in rest]).astype(np.float32)
            highs = np.append(highs, [high for _, high in rest]).astype(np.float32)
        return lows, highs

    def _extremes(self, channel: int, first: int, last: int, level: int) -> tuple[float, float]:
        """Extremes of ticks first … last-1, from ``level`` down; first is a multiple of a block."""
        low = high = np.float32(np.nan)
        while first < last:
            if level < 0:
                rows = self.channels[channel].read(self.record.columns, first, last)
                parts, first = (rows, rows), last
            else:
                unit = STEP ** (level + 1)
                a, b = first // unit, min(last // unit, self._full[level])
                lows, highs = self._levels[level]
                parts = lows[channel, a:b], highs[channel, a:b]
                first, level = max(first, b * unit), level - 1
            if len(parts[0]):
                low = np.fmin(low, np.fmin.reduce(parts[0]))
                high = np.fmax(high, np.fmax.reduce(parts[1]))
        return float(low), float(high)
