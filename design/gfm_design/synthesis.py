"""Fixed-structure H-infinity synthesis: the free gains that make gamma least.

The problem is neither smooth nor convex: the peak jumps between channels and resonances, and the
stable set has a hard edge. CMA-ES (N. Hansen, "The CMA evolution strategy", 2016) ranks points and
asks for no gradient, so both are no trouble to it; it is what did best among the optimisers tried.
Gains that cannot change sign are searched by their logarithm. Each other gain is scaled by the
change that moves the cost by half, found from the start, so that one step size fits all.

An unstable point costs more than any stable one, by its spectral abscissa: the search first
stabilises, then improves.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.gains import FreeGain

Vector = NDArray[np.float64]

#: what is to be made least; inf-free: an unusable point costs ``UNSTABLE`` and more
Cost = Callable[[Vector], float]

UNSTABLE = 1e6
_SPREAD_LOG = 0.5  # a gain by its logarithm starts with a spread of e^0.5
_STEP = 0.5  # CMA-ES's first step, in these scales
_POPULATION = 16


@dataclass(frozen=True)
class Tuned:
    """What a search found.

    Attributes:
        values: the free gains, in the order given.
        cost: what the search's own cost says of them.
        evaluations, seconds: what it took.
        seed: what makes it repeatable.
    """

    values: Vector
    cost: float
    evaluations: int
    seconds: float
    seed: int


class NotStabilised(ArithmeticError):
    """No usable gains were found; the message says how far the best ones came."""


def unstable_cost(abscissa: float) -> float:
    """Cost of a point whose largest growth is ``abscissa`` [1/s] >= 0."""
    return UNSTABLE * (1.0 + min(abscissa, 1e6) / 1e6) + abscissa


def tune(
    cost: Cost,
    gains: Sequence[FreeGain],
    seed: int = 0,
    evaluations: int = 6000,
    progress: Callable[[int, float], None] = lambda done, best: None,
) -> Tuned:
    """Search the free gains within their bounds for the least cost; the same for a seed.

    Args:
        cost: of the gains' values, in their order.
        gains: with starts and bounds.
        seed: of the search.
        evaluations: how many costs may be asked for.
        progress: told the evaluations done and the best cost so far.

    Raises:
        NotStabilised: not one point with a cost below ``UNSTABLE``.
        ModuleNotFoundError: the package cma is missing (extra ``design``).
    """
    try:
        import cma
    except ModuleNotFoundError:
        raise ModuleNotFoundError("synthesis needs cma: pip install 'gfmhil[design]'") from None
    begin = time.perf_counter()
    code = Encoding(cost, gains)
    search = cma.CMAEvolutionStrategy(
        np.zeros(len(gains)),
        _STEP,
        {
            "seed": seed + 1,  # cma takes 0 as "from the clock"
            "verbose": -9,
            "popsize": _POPULATION,
            "maxfevals": evaluations,
            "tolfun": 1e-7,
        },
    )
    best, best_cost = code.values(np.zeros(len(gains))), np.inf
    while not search.stop():
        points = search.ask()
        costs = []
        for point in points:
            values = code.values(point)
            costs.append(cost(values) + code.outside(point))
            if costs[-1] < best_cost:
                best, best_cost = values, costs[-1]
        search.tell(points, costs)
        progress(search.result.evaluations, best_cost)
    if best_cost >= UNSTABLE:
        raise NotStabilised(
            f"no stabilising gains within the bounds after {search.result.evaluations} tries; "
            f"the best still grow by {best_cost % UNSTABLE:.3g} 1/s"
        )
    return Tuned(best, best_cost, int(search.result.evaluations), time.perf_counter() - begin, seed)


class Encoding:
    """Between the gains and the search's coordinates, in which the start is 0."""

    def __init__(self, cost: Cost, gains: Sequence[FreeGain]) -> None:
        self._gains = gains
        self._start = np.array([g.start for g in gains])
        self._low = np.array([g.low for g in gains])
        self._high = np.array([g.high for g in gains])
        self._by_ratio = np.array([g.by_ratio for g in gains])
        here = cost(self._start)
        self._scale = np.array(
            [_SPREAD_LOG if g.by_ratio else self._reach(cost, here, k) for k, g in enumerate(gains)]
        )

    def values(self, point: Vector) -> Vector:
        """The gains at a point, moved into their bounds."""
        moved = self._start + point * self._scale
        ratio = self._start * np.exp(np.where(self._by_ratio, point * self._scale, 0.0))
        return np.clip(np.where(self._by_ratio, ratio, moved), self._low, self._high)

    def outside(self, point: Vector) -> float:
        """A small cost for coordinates beyond the bounds, so that the search turns back."""
        moved = self._start + point * self._scale
        ratio = self._start * np.exp(np.where(self._by_ratio, point * self._scale, 0.0))
        wanted = np.where(self._by_ratio, ratio, moved)
        beyond = np.abs(wanted - np.clip(wanted, self._low, self._high))
        return float(np.sum(beyond / (self._high - self._low)))

    def _reach(self, cost: Cost, here: float, k: int) -> float:
        """The change of gain k that moves the cost by half, or makes the loop unstable."""
        size = self._high[k] - self._low[k]
        for _ in range(40):
            changed = 0.0
            for sign in (1.0, -1.0):
                values = self._start.copy()
                values[k] = np.clip(values[k] + sign * size, self._low[k], self._high[k])
                changed = max(changed, abs(cost(values) - here))
            if changed <= 0.5 * abs(here):
                break
            size /= 2
        return float(size)
