"""Between a law's gains and the coordinates in which a search takes its steps.

A gain that cannot change its sign is searched by its logarithm. Any other is searched by asinh of
the gain over a hundredth of its bound: linear near zero, logarithmic far from it. So one step
size fits gains that differ by five decades, and a value near zero stays within reach of both
bounds.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_design.gains import FreeGain

Vector = NDArray[np.float64]

_LINEAR = 0.01  # share of the bound up to which the coordinate is about linear


class Encoding:
    """Coordinates of gains, with their bounds.

    Attributes:
        start, low, high: coordinates of the start and of the bounds.
    """

    def __init__(self, gains: Sequence[FreeGain]) -> None:
        self._by_ratio = np.array([g.by_ratio for g in gains])
        self._bounds = np.array([[g.low for g in gains], [g.high for g in gains]])
        self._linear = _LINEAR * np.abs(self._bounds).max(axis=0)
        self.start = self.coordinates(np.array([g.start for g in gains]))
        self.low, self.high = (self.coordinates(b) for b in self._bounds)

    def values(self, point: Vector) -> Vector:
        """The gains at coordinates, one row a point or a single one, held within the bounds."""
        held = np.clip(point, self.low, self.high)
        ratio = np.exp(np.where(self._by_ratio, held, 0.0))
        other = self._linear * np.sinh(np.where(self._by_ratio, 0.0, held))
        return np.clip(np.where(self._by_ratio, ratio, other), *self._bounds)

    def coordinates(self, values: Vector) -> Vector:
        """The coordinates of gains."""
        ratio = np.log(np.where(self._by_ratio, values, 1.0))
        return np.where(self._by_ratio, ratio, np.arcsinh(values / self._linear))
