"""The last steps to a least gamma: raise the least of 1/height over all high peaks step by step.

Near a minimum several peaks are equally high, along a curved ridge. Each step maximises the least
of their second-order models within a trust region, and is accepted if the true peaks improve as
well. The models are of 1/height: the height of a resonance is inversely proportional to its
damping, which is nearly linear in the gains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.peaks import Loops, PeakModel, model, peaks
from gfm_design.norms.performance import Weight

Vector = NDArray[np.float64]

_FIRST, _SMALLEST = 0.3, 1e-4  # first and smallest trust region, in the search's coordinates
_STEEP = 3.0  # how much the slope of ln(height) along a coordinate reduces the region there
_ACCEPTED = 0.1  # least fraction of the predicted improvement for a step to be accepted
_WORTH, _PATIENCE = 1e-4, 6  # least relative improvement over this number of rounds


def polish(
    loops: Loops,
    weights: tuple[Weight, ...],
    start: Vector,
    low: Vector,
    high: Vector,
    rounds: int = 60,
) -> Vector:
    """Coordinates near ``start``, within [low, high], at which the highest peak is least.

    Args:
        loops: T(s) at given coordinates; rows of coordinates give loops stacked on axis 0.
        weights: W_ij.
        start: a stable point; an unstable one is returned unchanged.
        low, high: limits of each coordinate.
        rounds: most steps.
    """
    at, reach = np.clip(start, low, high), _FIRST
    now = peaks(loops(at), weights)
    nearby: PeakModel | None = None
    past: list[float] = []
    while now is not None and len(past) < rounds and reach > _SMALLEST:
        past.append(float(now.height[0]))
        if len(past) > _PATIENCE and past[-1] > (1.0 - _WORTH) * past[-1 - _PATIENCE]:
            break
        if nearby is None:
            nearby = model(loops, weights, at, now)
        # a smaller region along coordinates on which a height depends steeply
        far = reach / (1.0 + _STEEP * np.abs(nearby.slope / nearby.base[:, None]).max(axis=0))
        step = _best_step(nearby, np.maximum(low - at, -far), np.minimum(high - at, far))
        least = nearby.base.min()
        promised = nearby(step).min() - least
        if promised <= 1e-9 * least:
            break
        then = peaks(loops(at + step), weights)
        gained = 1.0 / then.height[0] - least if then is not None else -np.inf
        if gained > _ACCEPTED * promised:
            at, now, nearby = at + step, then, None
            if gained > 0.7 * promised and np.abs(step / far).max() > 0.9:
                reach *= 2.0
        else:
            reach *= np.abs(step / far).max() / 3.0
    return np.clip(at, low, high)


def _best_step(nearby: PeakModel, low: Vector, high: Vector) -> Vector:
    """The step in [low, high] after which the least of the models is greatest."""
    from scipy.optimize import minimize

    n = len(low)
    found = minimize(
        lambda z: -z[n],
        np.r_[np.zeros(n), nearby.base.min()],
        jac=lambda z: np.r_[np.zeros(n), -1.0],
        bounds=[*zip(low, high, strict=True), (None, None)],
        constraints={
            "type": "ineq",
            "fun": lambda z: nearby(z[:n]) - z[n],
            "jac": lambda z: np.hstack([nearby.slopes(z[:n]), -np.ones((len(nearby.base), 1))]),
        },
        method="SLSQP",
        options={"maxiter": 40, "ftol": 1e-9},
    )
    return np.clip(found.x[:n], low, high)
