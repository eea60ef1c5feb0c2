"""``design tune``: choose a law's free gains for the least gamma of the paper's problem.

The search is many short ones, each followed by a polish. The problem has several minima (MIMO-GFM
has one at 1.43 with a fast DC loop and one at 1.33 with a slow one), and the polish converges to
one from far away.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.hinf import Unstable
from gfm_design.norms.peaks import model, peaks
from gfm_design.norms.performance import StateSpace, Weight
from gfm_design.tuning.gains import Encoding
from gfm_design.tuning.paper_problem import PaperProblem
from gfm_design.tuning.synthesis import NotStabilised, Tuned, tune
from gfm_plant import NoEquilibrium

Vector = NDArray[np.float64]

EVALUATIONS = 240  # of each start, before its polish
_STARTS = 6  # and one more for every gain
_SAME = 1e-6  # relative: heights this close count as equal, and as independent of a gain
_SETTLES = 3  # most polishes, each at the operating point of the previous result


def starts_for(gains: int) -> int:
    """Number of starts for a law with this number of free gains."""
    return _STARTS + gains


def tune_paper(
    problem: PaperProblem,
    seed: int = 0,
    evaluations: int = EVALUATIONS,
    starts: int | None = None,
    progress: Callable[[int, float], None] = lambda done, best: None,
) -> Tuned:
    """Choose the gains of ``problem``: a seed always gives the same gains, never worse than the
    starting ones.

    If no gain changes the highest channel (for example W_41 T_41(0) of a law with another droop
    than the problem's), gamma does not distinguish good gains from bad ones. The search then
    minimises the largest of the channels that the gains change.

    The search uses the operating point of the starting gains. If the found gains have another one,
    the last steps are repeated there, and ``problem`` is moved there. ``cost`` is gamma with the
    guarantee of ``norms.hinf`` at that point.

    Args:
        problem: law, free gains with starts and bounds, weights.
        seed: of the search.
        evaluations: of each start, once it is stable.
        starts: the given one and random ones; by default more for a law with more gains.
        progress: called with the evaluations done and the best gamma so far.

    Raises:
        NotStabilised: no stable loop was found.
    """
    begin = time.perf_counter()
    starts = starts or starts_for(len(problem.gains))
    found = _settled(problem, tune(problem, problem.gains, seed, evaluations, starts, progress))
    fixed = _fixed(problem, found.values)
    moved = tuple(w for w in problem.weights if w not in fixed)
    if fixed and moved:
        told, gamma = found.evaluations, found.cost
        rest = replace(problem, weights=moved)
        again = tune_paper(
            rest, seed, evaluations, starts, lambda done, best: progress(told + done, gamma)
        )
        found = replace(found, evaluations=told + again.evaluations)
        cost = _gamma(problem, again.values)
        if cost <= (1.0 + _SAME) * gamma:
            found = replace(found, values=again.values, cost=cost)
        problem.move_to(problem.law.named(found.values))
    return replace(found, seconds=time.perf_counter() - begin)


def _settled(problem: PaperProblem, found: Tuned) -> Tuned:
    """The best of the start, of ``found``, and of its polish at its own operating point."""
    code = Encoding(problem.gains)
    candidates, at = [code.values(code.start), found.values], found.values
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
    return replace(found, values=values, cost=min(gammas))


def _fixed(problem: PaperProblem, values: Vector) -> set[Weight]:
    """The highest channels, if no gain changes them."""
    code = Encoding(problem.gains)
    at = code.coordinates(values)

    def loops(x: Vector) -> StateSpace:
        return problem.loops(code.values(x))

    found = peaks(loops(at), problem.weights)
    if found is None:
        return set()
    nearby = model(loops, problem.weights, at, found)
    still = np.abs(nearby.slope).max(axis=1) < _SAME * nearby.base
    highest = found.height > (1.0 - _SAME) * found.height[0]
    # if a gain can lower one of the highest channels, gamma is the right cost
    return {problem.weights[c] for c in found.channel[highest & still]} if still[0] else set()


def _gamma(problem: PaperProblem, values: Vector) -> float:
    """gamma at the operating point of these gains; inf if there is none."""
    try:
        problem.move_to(problem.law.named(values))
        return max(c.norm for c in problem.channels(values))
    except (Unstable, NoEquilibrium):
        return np.inf
