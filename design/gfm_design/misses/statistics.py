"""Misses as they were measured: a Markov chain fitted to them, and the mean square under it.

The chain is that of E. N. Gilbert (Bell System Technical Journal 39, 1960): after a hit a miss
comes with probability ``begins``, after a miss another one with ``continues``. With it the sampled
loop is a Markov jump linear system. Its second moments Q_j = E[x x^T, outcome j] follow

    Q_j[k+1] = A_j (sum_i p_ij Q_i[k]) A_j^T + pi_j w w^T,

a linear map, whose spectral radius says whether the mean square decays, and whose fixed point is
the variance under white noise w (O. L. V. Costa, M. D. Fragoso and R. P. Marques, Discrete-Time
Markov Jump Linear Systems, Springer 2005, Chapter 3).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import eigs

from gfm_design.misses.ticks import Matrix, Ticks

_NEVER = 1e-300
_HALVINGS = 8
_FEW = 400  # rows of a map whose eigenvalues are all sought


@dataclass(frozen=True)
class Misses:
    """Ticks without a new u, as they were measured.

    Attributes:
        ticks: of the measurement.
        bursts: (misses in a row, how many such bursts), in ascending order.
        where: the outcome of each tick in order, True for a miss; None if it is not known, as from
            the result of a benchmark.
    """

    ticks: int
    bursts: tuple[tuple[int, int], ...]
    where: NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, missed: ArrayLike) -> Misses:
        """Those of a sequence of outcomes, True for a miss."""
        where = np.asarray(missed, bool)
        ends = np.flatnonzero(np.diff(np.pad(where, 1).astype(int)))
        lengths = Counter((ends[1::2] - ends[::2]).tolist())
        return cls(len(where), tuple(sorted(lengths.items())), where)

    @property
    def misses(self) -> int:
        """How many ticks were missed."""
        return sum(length * many for length, many in self.bursts)

    @property
    def longest(self) -> int:
        """Misses in a row at most."""
        return max((length for length, _ in self.bursts), default=0)

    @property
    def mean_age(self) -> float:
        """By how many ticks the u that acted was older than one that comes in time, on average."""
        return sum(n * (n + 1) / 2 * many for n, many in self.bursts) / max(self.ticks, 1)

    def most_in(self, K: int) -> int | None:
        """Misses in K ticks at most; None if their places are not known."""
        if self.where is None:
            return None
        total = np.concatenate([[0], np.cumsum(self.where)])
        K = min(K, self.ticks)
        return int((total[K:] - total[: len(total) - K]).max())

    def chain(self) -> MissChain:
        """The chain that makes these misses the most likely; without any, one without misses."""
        bursts = sum(many for _, many in self.bursts)
        hits = self.ticks - self.misses
        begins = min(bursts / hits, 1.0) if hits else 1.0
        return MissChain(begins, 1.0 - bursts / self.misses if bursts else 0.0)


@dataclass(frozen=True)
class MissChain:
    """Probabilities of a miss after a hit, and after a miss."""

    begins: float
    continues: float

    @property
    def share(self) -> float:
        """Of ticks that are missed."""
        leaves = 1.0 - self.continues
        return self.begins / (self.begins + leaves) if self.begins else 0.0

    def drawn(self, ticks: int, runs: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Outcomes of runs that begin with a hit, True for a miss; shape (runs, ticks)."""
        chance, last = rng.random((ticks, runs)), np.zeros(runs, bool)
        out = np.empty((ticks, runs), bool)
        for k in range(ticks):
            out[k] = last = chance[k] < np.where(last, self.continues, self.begins)
        return out.T


class MeanSquare:
    """The second moments of a loop under a chain of misses.

    Raises:
        ValueError: the plant continues u's trend, so that misses differ by their place in a row.
    """

    def __init__(self, ticks: Ticks, chain: MissChain) -> None:
        if len(ticks.misses) != 1:
            raise ValueError("extrapolate: the mean square is that of a u that is held")
        self.ticks, self.chain = ticks, chain
        self._half, (hit, miss) = np.triu_indices(len(ticks.hit)), _moments(ticks)
        b, on = chain.begins, chain.continues
        self._map = np.block([[(1 - b) * hit, (1 - on) * hit], [b * miss, on * miss]])

    def without(self) -> MeanSquare:
        """That of the loop that misses nothing."""
        return MeanSquare(self.ticks, MissChain(0.0, 0.0))

    @cached_property
    def stable(self) -> bool:
        """Whether the mean square decays: exactly if Q = I + map(Q) has a positive solution."""
        one = np.eye(len(self.ticks.hit))
        try:
            for Q in self._at_rest(one, one):
                np.linalg.cholesky(Q)
        except np.linalg.LinAlgError:
            return False
        return True

    def _at_rest(self, *added: Matrix) -> tuple[Matrix, ...]:
        """The fixed point Q_j of the map to which ``added`` comes in each tick, of both outcomes.
        Raises LinAlgError: there is none."""
        both = np.concatenate([one[self._half] for one in added])
        Q = np.linalg.solve(np.eye(len(both)) - self._map, both)
        of = []
        for elements in np.split(Q, len(added)):
            full = np.zeros_like(self.ticks.hit)
            full[self._half] = elements
            of.append(full + full.T - np.diag(np.diag(full)))
        return tuple(of)

    def sigma(self) -> float:
        """Rate at which the root of the mean square grows, 1/s; stable below 0."""
        if self.stable and len(self._map) > _FEW:
            # that of a map that keeps Q >= 0 is real, and none below 1 is closer to 1
            begin = np.ones(len(self._map))  # else a random one, and other last digits each time
            near = eigs(self._map, 1, sigma=1.0, v0=begin, return_eigenvectors=False)
        else:
            near = np.linalg.eigvals(self._map)
        size = float(np.abs(near).max())
        return 0.5 * float(np.log(max(size, _NEVER))) / self.ticks.T_s

    def variance(self) -> Matrix:
        """That of y = (v_dc, p, omega_u, q, V), shape (5,), under white noise of the grid's
        voltage of 1 p.u. a tick; inf if the mean square does not decay."""
        if not self.stable:
            return np.full(len(self.ticks.outputs), np.inf)
        added, share = np.outer(self.ticks.noise, self.ticks.noise), self.chain.share
        total = sum(self._at_rest((1 - share) * added, share * added))
        C = self.ticks.outputs
        return np.asarray(np.einsum("ij,jk,ik->i", C, total, C))


@lru_cache(maxsize=2)
def _moments(ticks: Ticks) -> tuple[Matrix, Matrix]:
    """What a hit and a miss make of the elements of a symmetric Q on and above its diagonal."""
    N = len(ticks.hit)
    rows, columns = np.triu_indices(N)
    spread = np.zeros((N * N, len(rows)))
    k = np.arange(len(rows))
    spread[rows * N + columns, k] = spread[columns * N + rows, k] = 1.0
    hit, miss = (np.kron(A, A)[rows * N + columns] @ spread for A in (ticks.hit, ticks.misses[0]))
    return hit, miss


def most_misses(ticks: Ticks, continues: float) -> float | None:
    """The largest share of missed ticks with which the mean square still decays.

    ``continues`` is the probability that a miss follows a miss. None: it decays even with almost
    every tick missed.
    """

    def stable(begins: float) -> bool:
        return MeanSquare(ticks, MissChain(begins, continues)).stable

    low, high = 0.0, 1.0
    if stable(high):
        return None
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return MissChain(low, continues).share
