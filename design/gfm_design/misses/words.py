"""How many misses in a row a loop bears, by words: n misses, then m hits, repeated for ever.

A word's spectral radius says whether its repetition is stable. The loop bears n misses in a row if
no word of up to n misses, with any number of hits behind them, is unstable. Such words are what a
disturbance that comes back does; whether every sequence is stable is asked in ``sequences``.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gfm_design.misses.ticks import Matrix, Ticks

MOST = 1000  # misses in a row that are tried
_DENSE, _LONGEST, _COARSE = 30, 800, 60  # hits: all up to there, then so many up to there


@dataclass(frozen=True)
class Word:
    """``misses`` in a row, then ``hits``, repeated."""

    misses: int
    hits: int
    sigma: float  # rate at which it grows, 1/s; stable below 0

    def __str__(self) -> str:
        return f"{self.misses} misses, {self.hits} hit{'s' * (self.hits > 1)}"


class Words:
    """The words of one loop's ticks."""

    def __init__(self, ticks: Ticks) -> None:
        self.ticks, self._worst = ticks, dict[int, Word]()
        self._runs = [np.eye(len(ticks.hit))]

    def run(self, n: int) -> Matrix:
        """The product of n misses in a row, shape (N, N)."""
        while len(self._runs) <= n:
            self._runs.append(self.ticks.miss(len(self._runs) - 1) @ self._runs[-1])
        return self._runs[n]

    @cached_property
    def _hits(self) -> tuple[NDArray[np.int64], Matrix]:
        many = np.geomspace(_DENSE, _LONGEST, _COARSE).round().astype(int)
        m = np.unique(np.concatenate([np.arange(1, _DENSE), many]))
        return m, np.array([np.linalg.matrix_power(self.ticks.hit, int(k)) for k in m])

    def worst(self, n: int) -> Word:
        """The word of n misses that grows fastest, or decays most slowly."""
        if n not in self._worst:
            m, hits = self._hits
            size = np.abs(np.linalg.eigvals(hits @ self.run(n))).max(axis=1)
            with np.errstate(divide="ignore"):
                sigma = np.log(size) / ((m + n) * self.ticks.T_s)
            k = int(np.argmax(sigma))
            self._worst[n] = Word(n, int(m[k]), float(sigma[k]))
        return self._worst[n]

    def first_unstable(self, most: int = MOST) -> Word | None:
        """The unstable word with the fewest misses; None if all of up to ``most`` are stable."""
        return next((w for n in range(1, most + 1) if (w := self.worst(n)).sigma >= 0.0), None)

    def slowest(self, n: int) -> Word:
        """Of all words of up to n misses the one that grows fastest; 0 misses: the loop itself."""
        return max((self.worst(i) for i in range(n + 1)), key=lambda word: word.sigma)
