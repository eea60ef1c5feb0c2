"""The paper's performance problem (Section III-B): w, z, the six weights, and the channels' norms.

    w = (P_ref, omega_g),   z = (P_ref - p, p, omega_u, q + V/D_q)

gamma is the H-infinity norm of diag(W_ij T_ij), which is the largest of the six channels' norms.
Signals are deviations in p.u. from an operating point; omega_g is the grid's frequency, and the
controller's own reference omega_g stays where it is (no PLL, as in the paper's MIMO-GFM).
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.hinf import Norm, hinf_norm
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml
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


_LEAD = (1.447e-3, 1.0), (1.447e-5, 1.0)


def _squared(c: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(float(v) for v in np.polymul(c, c))


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


_DEGREE = 8


def read_weights(path: Path) -> tuple[Weight, ...]:
    """The weights of a file.

    Raises:
        ValueError: it cannot be read, is not TOML, or has an invalid weight; it names the first.
    """
    content = read_toml(path)
    if not content:
        raise ValueError("holds no weight; e.g. [W_11] with num and den")
    return tuple(_weight(name, entry) for name, entry in content.items())


def _weight(name: str, entry: Any) -> Weight:
    found = re.fullmatch(r"W_([1-4])([12])", name)
    if not found:
        raise ValueError(f"{printable(name)}: a weight is W_ij, i = 1..4 of z and j = 1..2 of w")
    if not isinstance(entry, dict) or set(entry) != {"num", "den"}:
        raise ValueError(f"{name}: needs num and den, and nothing else")
    num, den = (_coefficients(f"{name}.{side}", entry[side]) for side in ("num", "den"))
    return Weight(int(found[1]), int(found[2]), num, den)


def _coefficients(where: str, value: Any) -> tuple[float, ...]:
    listed = isinstance(value, list) and 1 <= len(value) <= _DEGREE + 1
    if not listed or not all(type(c) in (int, float) for c in value):
        raise ValueError(f"{where}: must be a list of 1 to {_DEGREE + 1} numbers")
    try:
        return tuple(float(c) for c in value)
    except OverflowError:
        raise ValueError(f"{where}: a number is too large") from None
