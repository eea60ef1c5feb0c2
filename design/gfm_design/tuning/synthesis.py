"""Fixed-structure H-infinity synthesis: the free gains that minimise gamma.

The problem is neither smooth nor convex: the peak jumps between channels and resonances, and the
cost jumps at the limit of stability. CMA-ES (N. Hansen, "The CMA evolution strategy", 2016) only
ranks points and needs no gradient; it gave the best results among the optimisers that we tried. A
problem may have a polish, which improves the result of CMA-ES by following the active peaks.

If the polish converges from far away, many short runs of CMA-ES find lower minima than a few long
ones in the same time (``tune_paper``); without a polish, long runs are better (``tune``).

An unstable point costs more than any stable one, by its spectral abscissa: the search first
stabilises the loop, then lowers gamma.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from gfm_design.tuning.gains import Encoding, FreeGain

Vector = NDArray[np.float64]

UNSTABLE = 1e6  # least cost of an unusable point
_STEP = 0.5  # CMA-ES's first step, in the coordinates of ``Encoding``
_POPULATION = 32
_SAMPLES = 400  # random points; the best one starts a further run
_HOPELESS = 6  # the search ends after this number of runs without a usable point
_STABILISE = 4000  # evaluations that a run may always use to find a usable point


class Problem(Protocol):
    """A cost to minimise."""

    def __call__(self, values: Vector) -> float:
        """Cost of one set of gains, finite; at least ``UNSTABLE`` if they are unusable."""

    def many(self, values: Vector) -> Vector:
        """Costs of several sets of gains, one a row."""

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """A better point nearby, in the search's coordinates; may be the point itself."""


@dataclass(frozen=True)
class Tuned:
    """The result of a search."""

    values: Vector  #: the free gains, in the given order
    cost: float  #: of these gains
    #: evaluations of CMA-ES, without the polish; seconds of all
    evaluations: int
    seconds: float
    seed: int  #: of the random numbers; a seed always gives the same result


class NotStabilised(ArithmeticError):
    """The search found no usable gains. ``values`` are the best that it tried."""

    def __init__(self, values: Vector, evaluations: int, cost: float) -> None:
        self.values = values
        super().__init__(
            f"no stabilising gains within the bounds after {evaluations} tries; "
            f"the best still grow by {cost % UNSTABLE:.3g} 1/s"
        )


def unstable_cost(abscissa: Vector) -> Vector:
    """Cost of points whose largest growth is ``abscissa`` [1/s] >= 0."""
    # the digits below UNSTABLE hold the growth, so that callers can recover it from a cost
    return UNSTABLE + np.clip(abscissa, 0.0, 0.99 * UNSTABLE)


def tune(
    problem: Problem,
    gains: Sequence[FreeGain],
    seed: int = 0,
    evaluations: int = 12000,
    starts: int = 2,
    progress: Callable[[int, float], None] = lambda done, best: None,
) -> Tuned:
    """Search the free gains within their bounds for the least cost; a seed always gives the same
    gains.

    Args:
        problem: the cost.
        gains: with starts and bounds.
        seed: of the search.
        evaluations: most evaluations of each run after its first usable point.
        starts: number of runs; the first begins at the gains' own start, the others at the best of
            some random points within the bounds.
        progress: called with the evaluations done and the best cost so far.

    Raises:
        NotStabilised: no point has a cost below ``UNSTABLE``.
        ModuleNotFoundError: the package cma is missing (extra ``design``).
    """
    begin, done = time.perf_counter(), 0
    code = Encoding(gains)
    random = np.random.default_rng(seed)
    best, best_cost = code.start, problem(code.values(code.start))
    for run in range(starts):
        point = code.start
        if run > 0:
            points = random.uniform(code.low, code.high, (_SAMPLES, len(gains)))
            point = points[np.argmin(problem.many(code.values(points)))]

        def tell(asked: int, cost: float, told: int = done, so_far: float = best_cost) -> None:
            progress(told + asked, min(so_far, cost))

        run_seed = int(random.integers(1, 2**31))
        found, asked = _search(problem, code, point, run_seed, evaluations, tell)
        done += asked
        if problem(code.values(found)) < UNSTABLE:
            found = problem.polish(code, found)
        cost = problem(code.values(found))
        if cost < best_cost:
            best, best_cost = found, cost
        if run + 1 == _HOPELESS and best_cost >= UNSTABLE:
            break
    if best_cost >= UNSTABLE:
        raise NotStabilised(code.values(best), done, best_cost)
    last = problem.polish(code, best)
    if problem(code.values(last)) < best_cost:
        best, best_cost = last, problem(code.values(last))
    values = code.values(best)
    return Tuned(values, best_cost, done, time.perf_counter() - begin, seed)


def _search(
    problem: Problem,
    code: Encoding,
    start: Vector,
    seed: int,
    evaluations: int,
    tell: Callable[[int, float], None],
) -> tuple[Vector, int]:
    """The best point of one run of CMA-ES, and the number of its evaluations."""
    try:
        import cma
    except ModuleNotFoundError:
        raise ModuleNotFoundError("synthesis needs cma: pip install 'gfmhil[design]'") from None
    # cma needs two dimensions at least: add a coordinate without effect
    idle = 1 if len(start) == 1 else 0
    limits = [[*code.low, *[-1.0] * idle], [*code.high, *[1.0] * idle]]
    options = {"seed": seed, "verbose": -9, "popsize": _POPULATION, "tolfun": 1e-5,
               "maxfevals": max(evaluations, _STABILISE), "bounds": limits}  # fmt: skip
    search = cma.CMAEvolutionStrategy(np.r_[start, np.zeros(idle)], _STEP, options)
    best, best_cost, usable = start, np.inf, 0
    while not search.stop() and usable < evaluations:
        asked = search.ask()
        points = np.array(asked)[:, : len(start)]
        costs = problem.many(code.values(points))
        k = int(np.argmin(costs))
        if costs[k] < best_cost:
            best, best_cost = points[k], float(costs[k])
        usable += len(costs) if best_cost < UNSTABLE else 0
        search.tell(asked, list(costs))
        tell(int(search.result.evaluations), best_cost)
    return best, int(search.result.evaluations)
