"""The paper's problem, constrained to gains whose loop is stable with sampling and delay.

gamma is that of the ideal continuous loop. Gains whose loop, sampled and with one sample of delay,
decays too slowly or grows count as unstable. Without this constraint the search may end at gains
that the kernel cannot run: sampling alone can destabilise the lightly damped LC resonance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearLaw
from gfm_design.tuning.gains import Encoding
from gfm_design.tuning.paper_problem import PaperProblem
from gfm_design.tuning.synthesis import UNSTABLE, unstable_cost

Vector = NDArray[np.float64]

ALPHA = 1.0  # 1/s
_SHARES = (1.0, 0.3, 0.1)  # of a polish's step that are tried


class LateProblem:
    """Cost of a law's gains; a problem for ``synthesis.tune``.

    Args:
        paper: computes gamma.
        alpha: least decay rate of every mode, 1/s.
    """

    def __init__(self, paper: PaperProblem, alpha: float = ALPHA) -> None:
        self.paper, self._alpha = paper, alpha

    def sigma(self, values: Vector) -> Vector:
        """Largest real part of any mode, 1/s, by rows of gains; inf where they give no law."""
        law, late = self.paper.law(values), self.paper.late
        good = np.isfinite(law.A).all(axis=(1, 2)) & np.isfinite(law.D).all(axis=(1, 2))
        out = np.full(len(values), np.inf)
        if good.any():
            some = LinearLaw(*(m[good] for m in law.matrices)).sampled(self.paper.T_s)
            out[good] = late.with_law(some).sigma()
        return out

    def __call__(self, values: Vector) -> float:
        """gamma, or the cost of gains that violate the constraint."""
        return float(self.many(values[None, :])[0])

    def many(self, values: Vector) -> Vector:
        """Costs of several sets of gains, one a row."""
        costs = self.paper.many(values)
        stable = np.flatnonzero(costs < UNSTABLE)
        if len(stable):
            missing = self.sigma(values[stable]) + self._alpha
            costs[stable] = np.where(missing > 0.0, unstable_cost(missing), costs[stable])
        return costs

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """The best point on the way to a lower gamma nearby that meets the constraint."""
        step = self.paper.polish(code, point) - point
        tried = np.array([point, *(point + share * step for share in _SHARES)])
        best: Vector = tried[np.argmin(self.many(code.values(tried)))]
        return best
