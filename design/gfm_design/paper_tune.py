"""The free gains of a law for the least gamma of the paper's problem: what ``design tune`` calls.

Many short searches, each with a polish: the problem has several minima (MIMO-GFM one at 1.43 with
a fast DC loop and one at 1.33 with a slow one), and the polish finds the bottom of each from afar.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.encoding import Encoding
from gfm_design.hinf import Unstable
from gfm_design.paper_problem import PaperProblem
from gfm_design.synthesis import NotStabilised, Tuned, tune
from gfm_plant import NoEquilibrium

Vector = NDArray[np.float64]

EVALUATIONS = 240  # of each start, before its polish
_STARTS = 2, 2  # so many, and so many more for every gain
_SETTLES = 3  # polishes at the operating point of the gains that the last one came to


def starts_for(gains: int) -> int:
    """How many starts a law of so many free gains is given."""
    return _STARTS[0] + _STARTS[1] * gains


def tune_paper(
    problem: PaperProblem,
    seed: int = 0,
    evaluations: int = EVALUATIONS,
    starts: int | None = None,
    progress: Callable[[int, float], None] = lambda done, best: None,
) -> Tuned:
    """Choose the gains of ``problem``; the same for a seed, and never worse than its start.

    The search is made at the operating point of the starting gains; some laws rest elsewhere with
    other gains, and then the last steps are made there. ``cost`` is gamma with the guarantee of
    ``gfm_design.hinf``, at the operating point of the gains themselves, to which ``problem`` is
    moved.

    Args:
        problem: law, free gains with starts and bounds, weights.
        seed: of the search.
        evaluations: of each start, once it is stable.
        starts: the given one and random ones; by default more for a law with more gains.
        progress: told the evaluations done and the best gamma so far.

    Raises:
        NotStabilised: no stable loop was found.
    """
    begin = time.perf_counter()
    code = Encoding(problem.gains)
    start = code.values(code.start)
    found = tune(
        problem, problem.gains, seed, evaluations, starts or starts_for(len(start)), progress
    )
    candidates, at = [start, found.values], found.values
    for _ in range(_SETTLES):
        before = problem.op.x
        problem.move_to(problem.law.named(at))
        if np.allclose(problem.op.x, before, rtol=0.0, atol=1e-9):
            break
        at = code.values(problem.polish(code, code.coordinates(at)))
        candidates.append(at)
    gammas = [_gamma(problem, values) for values in candidates]
    values = candidates[int(np.argmin(gammas))]
    if not np.isfinite(min(gammas)):
        raise NotStabilised(values, found.evaluations, problem(values))
    problem.move_to(problem.law.named(values))
    return replace(found, values=values, cost=min(gammas), seconds=time.perf_counter() - begin)


def _gamma(problem: PaperProblem, values: Vector) -> float:
    """gamma at the operating point of these gains; inf if there is none."""
    try:
        problem.move_to(problem.law.named(values))
        return max(c.norm for c in problem.channels(values))
    except (Unstable, NoEquilibrium):
        return np.inf
