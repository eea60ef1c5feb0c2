"""The paper's problem for gains that can be run: sampled and one sample late, the loop must hold.

gamma is that of the ideal continuous loop; gains whose sampled loop decays too slowly, or grows,
count as unstable. Without that, the search may end at gains that the kernel cannot run: sampling
alone takes the LC resonance, lightly damped by the choke, across the border.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import hold
from gfm_design.tuning.gains import Encoding
from gfm_design.tuning.paper_problem import PaperProblem
from gfm_design.tuning.synthesis import UNSTABLE, unstable_cost
from gfm_runtime.signals import NU

Vector = NDArray[np.float64]

ALPHA = 1.0  # 1/s
_SHARES = (1.0, 0.3, 0.1)  # of a polish's step that are tried


class LateProblem:
    """Cost of a law's gains; a problem for ``synthesis.tune``.

    Args:
        paper: gamma.
        alpha: every mode decays at least so fast, 1/s.
    """

    def __init__(self, paper: PaperProblem, alpha: float = ALPHA) -> None:
        self.paper, self._alpha = paper, alpha

    def sigma(self, values: Vector) -> Vector:
        """Largest real part of any mode, 1/s, of sets of gains, one a row; inf where no law."""
        law, plant, T_s = self.paper.law(values), self.paper.linear, self.paper.T_s
        good = np.isfinite(law.A).all(axis=(1, 2)) & np.isfinite(law.D).all(axis=(1, 2))
        A, B, C, D = (m[good] for m in (law.A, law.B, law.C, law.D))
        # Tustin, as gfm_runtime.tustin
        half, eye = T_s / 2, np.eye(A.shape[1])
        backward = np.linalg.inv(eye - half * A)
        to_u = C @ backward
        F, G = hold(plant.A, plant.B, T_s)
        n, law_at = len(F), slice(len(F), len(F) + A.shape[1])
        loop = np.zeros((len(A), law_at.stop + NU, law_at.stop + NU))  # plant, law, u[k-1]
        loop[:, :n, :n], loop[:, :n, law_at.stop :] = F, G
        loop[:, law_at, :n] = T_s * backward @ B @ plant.C
        loop[:, law_at, law_at] = backward @ (eye + half * A)
        loop[:, law_at.stop :, :n] = (D + half * to_u @ B) @ plant.C
        loop[:, law_at.stop :, law_at] = to_u
        out = np.full(len(values), np.inf)
        out[good] = np.log(np.abs(np.linalg.eigvals(loop)).max(axis=1)) / T_s
        return out

    def __call__(self, values: Vector) -> float:
        """gamma, or what gains cost that do not hold."""
        return float(self.many(values[None, :])[0])

    def many(self, values: Vector) -> Vector:
        """Costs of several, one a row."""
        costs = self.paper.many(values)
        stable = np.flatnonzero(costs < UNSTABLE)
        if len(stable):
            missing = self.sigma(values[stable]) + self._alpha
            costs[stable] = np.where(missing > 0.0, unstable_cost(missing), costs[stable])
        return costs

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """As far towards a lower gamma nearby as the loop holds."""
        step = self.paper.polish(code, point) - point
        tried = np.array([point, *(point + share * step for share in _SHARES)])
        best: Vector = tried[np.argmin(self.many(code.values(tried)))]
        return best
