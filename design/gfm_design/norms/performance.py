"""The paper's performance problem (Section III-B): w, z, the six weights, and the channels' norms.

    w = (P_ref, omega_g),   z = (P_ref - p, p, omega_u, q + V/D_q)

gamma is the H-infinity norm of diag(W_ij T_ij), which is the largest of the six channels' norms.
Signals are deviations in p.u. from an operating point; omega_g is the grid's frequency, and the
controller's own reference omega_g stays where it is (no PLL, as in the paper's MIMO-GFM).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.hinf import Norm, hinf_norm
from gfm_runtime.tustin import tustin

Matrix = NDArray[np.float64]
StateSpace = tuple[Matrix, Matrix, Matrix, Matrix]

D_Q = 0.05  # p.u., Table III


_LARGEST = 1e30  # of a coefficient against den[0]; beyond it products overflow


@dataclass(frozen=True)
class Weight:
    """W_ij(s) = num(s)/den(s) on T_ij, the transfer function from w_j to z_i (i, j from 1).

    num, den: coefficients in descending powers of s.
    """

    i: int
    j: int
    num: tuple[float, ...]
    den: tuple[float, ...]

    def __post_init__(self) -> None:
        name = f"W_{self.i}{self.j}"
        if not (1 <= self.i <= 4 and 1 <= self.j <= 2):
            raise ValueError(f"{name}: i must be 1..4 and j 1..2")
        if len(self.num) > len(self.den):
            raise ValueError(
                f"{name}: improper, its numerator has degree {len(self.num) - 1} and its "
                f"denominator {len(self.den) - 1}; a weight must be proper"
            )
        if not self.num or not self.den:
            raise ValueError(f"{name}: needs a numerator and a denominator")
        if not np.isfinite([*self.num, *self.den]).all() or self.den[0] == 0.0:
            raise ValueError(f"{name}: coefficients must be finite, den[0] not 0")
        if np.abs([*self.num, *self.den]).max() > _LARGEST * abs(self.den[0]):
            raise ValueError(f"{name}: no coefficient may exceed {_LARGEST:g} times den[0]")
        if not any(self.num):
            raise ValueError(f"{name}: its numerator is zero; leave the weight out instead")
        if len(self.den) > 1 and np.roots(self.den).real.max() >= 0.0:
            raise ValueError(f"{name}: must be stable; {self.den} has a root outside")

    def __call__(self, s: NDArray[np.complexfloating]) -> NDArray[np.complexfloating]:
        """Value at the complex frequencies s [rad/s]."""
        return np.polyval(self.num, s) / np.polyval(self.den, s)

    def state_space(self, T_s: float | None = None) -> StateSpace:
        """Controllable canonical form; by Tustin if a sampling time T_s [s] is given."""
        den = np.asarray(self.den) / self.den[0]
        num = np.zeros(len(den))
        num[len(den) - len(self.num) :] = np.asarray(self.num) / self.den[0]
        n = len(den) - 1
        A, B = np.zeros((n, n)), np.zeros((n, 1))
        if n:
            A[0], B[0, 0] = -den[1:], 1.0
            A[1:, :-1] = np.eye(n - 1)
        C, D = (num[1:] - num[0] * den[1:])[None, :], np.array([[num[0]]])
        return (A, B, C, D) if T_s is None else tustin(A, B, C, D, T_s / 2)


def _lead(T_1: float, T_2: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    return (T_1, 1.0), (T_2, 1.0)


def _squared(c: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.polymul(c, c))


_LEAD = _lead(1.447e-3, 1.447e-5)

#: the paper's six weights, Table "Numbers Used in Weighting Functions"
PAPER_WEIGHTS: tuple[Weight, ...] = (
    Weight(1, 1, (1.0, 4.0), (1.0, 0.0004)),
    Weight(2, 1, _squared(_LEAD[0]), _squared(_LEAD[1])),
    Weight(2, 2, (1.447e-3 / 100, 1.0 / 100), _LEAD[1]),
    Weight(3, 1, (1.0 / 0.015, 0.0), _LEAD[1]),
    Weight(3, 2, *_LEAD),
    Weight(4, 1, (1.0, 60.0), (1.0, 0.006)),
)


@dataclass(frozen=True)
class WeightedChannel:
    """||W_ij T_ij||: its norm, and the frequency [rad/s] at which it is reached."""

    i: int
    j: int
    norm: float
    omega: float


def channel_system(loop: StateSpace, weight: Weight, T_s: float | None = None) -> StateSpace:
    """State space of W_ij T_ij; ``T_s`` [s] for a sampled loop."""
    A, B, C, D = loop
    b, c, d = B[:, [weight.j - 1]], C[[weight.i - 1]], D[[weight.i - 1], weight.j - 1][None, :]
    Aw, Bw, Cw, Dw = weight.state_space(T_s)
    return (
        np.block([[A, np.zeros((len(A), len(Aw)))], [Bw @ c, Aw]]),
        np.vstack([b, Bw @ d]),
        np.hstack([Dw @ c, Cw]),
        Dw @ d,
    )


def channel_norms(
    loop: StateSpace, weights: tuple[Weight, ...] = PAPER_WEIGHTS, T_s: float | None = None
) -> tuple[WeightedChannel, ...]:
    """The norm of every weighted channel, with the guarantee of ``hinf_norm``.

    Args:
        loop: T, continuous or, with a sampling time T_s [s], from tick to tick.
        weights: W_ij(s); a sampled loop has them by Tustin.
        T_s: of a sampled loop.

    Raises:
        Unstable: the loop is not stable; it has no gamma.
    """
    channels = []
    for weight in weights:
        norm: Norm = hinf_norm(*channel_system(loop, weight, T_s), T_s=T_s)
        channels.append(WeightedChannel(weight.i, weight.j, norm.gain, norm.omega))
    return tuple(channels)
