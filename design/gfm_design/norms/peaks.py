"""How high the weighted channels W_ij T_ij reach: for a search, and near a minimum.

``Screen`` is a fast estimate of gamma for a search that needs it thousands of times. It decomposes
the loops of a whole population into their modes at once, and evaluates all channels on a grid that
follows the modes, with points across every narrow resonance. The result is a lower bound close to
the norm; ``norms.hinf`` confirms the result of a search.

``peaks`` and ``model`` are for the last steps. A peak's height has derivatives over whatever the
loop's matrices depend on smoothly: with the resolvent R = (j omega - A)^-1, T = C R B + D, and
dR = R dA R. A peak also moves along the frequency as the gains move: over (x, ln omega) it is a
saddle, and ln omega is eliminated.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.performance import StateSpace, Weight

Vector = NDArray[np.float64]


class Sizes:
    """Magnitudes |W(j omega)| of several weights."""

    def __init__(self, weights: Sequence[Weight]) -> None:
        self._num, self._den = (
            _squared_sizes(side) for side in ([w.num for w in weights], [w.den for w in weights])
        )

    def squared(self, omega: Vector) -> Vector:
        """|W|^2 at omega [rad/s] of any shape; the weights are a last axis."""
        y = (omega * omega)[..., None]
        num, den = (y ** np.arange(c.shape[1]) @ c.T for c in (self._num, self._den))
        return np.asarray(num / den)

    def bend(self, omega: Vector, which: NDArray[np.intp]) -> Vector:
        """Second derivative of ln |W| with respect to omega, at omega (K,), for the weights
        ``which`` (K,)."""
        y, out = omega * omega, np.zeros(len(omega))
        for sign, c in ((0.5, self._num[which]), (-0.5, self._den[which])):
            k = np.arange(c.shape[1])
            powers = [y[:, None] ** np.maximum(k - m, 0) for m in range(3)]
            factors = [np.ones_like(k), k, k * (k - 1)]
            p, dp, ddp = ((c * f * q).sum(axis=1) for f, q in zip(factors, powers, strict=True))
            out += sign * (2 * dp / p + 4 * y * (ddp / p - (dp / p) ** 2))
        return out


@cache
def sizes_of(weights: tuple[Weight, ...]) -> Sizes:
    """The sizes of these weights; a polish asks for the same ones at every step."""
    return Sizes(weights)


def _squared_sizes(polynomials: list[tuple[float, ...]]) -> Vector:
    """|c(j omega)|^2 of each as a polynomial in omega^2, ascending; one a row."""
    out = np.zeros((len(polynomials), max(len(c) for c in polynomials)))
    for row, c in zip(out, polynomials, strict=True):
        ascending, signs = np.asarray(c)[::-1], (-1.0) ** np.arange(len(c))
        row[: len(c)] = np.convolve(ascending, ascending * signs)[::2] * signs
    return out


_BASE = np.concatenate(  # rad/s; as good as 0 and infinity at the ends, where many laws are worst
    [[1e-6, 1e-3], np.logspace(-2, 0, 10), np.logspace(0.05, 3, 70), np.logspace(3.1, 5, 20), [1e7]]
)
_NARROW = np.array([-2.0, -0.8, -0.3, 0.0, 0.3, 0.8, 2.0])  # half widths around a resonance


class Screen:
    """Screens closed loops against one set of weights."""

    def __init__(self, weights: tuple[Weight, ...]) -> None:
        self._rows = [w.i - 1 for w in weights]
        self._columns = [w.j - 1 for w in weights]
        self._sizes = Sizes(weights)
        self._on_base = self._sizes.squared(_BASE)

    def __call__(self, loops: StateSpace) -> tuple[Vector, Vector]:
        """(largest weighted gains, spectral abscissae in 1/s) of loops stacked on axis 0.

        The gain of an unstable loop is inf.
        """
        A, B, C, D = loops
        values, vectors = np.linalg.eig(A)
        values, vectors = values.astype(complex), vectors.astype(complex)
        abscissae = values.real.max(axis=1)
        gains = np.full(len(A), np.inf)
        good = np.flatnonzero(abscissae < 0.0)
        if len(good) == 0:
            return gains, abscissae
        values, vectors = values[good], vectors[good]
        seen = np.swapaxes((C[good] @ vectors)[:, self._rows], 1, 2)
        moved = np.linalg.solve(vectors, B[good].astype(complex))[:, :, self._columns]
        residues, through = seen * moved, D[good][:, None, self._rows, self._columns]

        def largest(omega: Vector, weight: Vector) -> Vector:
            response = (1.0 / (1j * omega[..., None] - values[:, None, :])) @ residues + through
            sizes = (response.real**2 + response.imag**2) * weight
            return np.sqrt(sizes.max(axis=(1, 2)))

        near = np.abs(values.imag[:, :, None] + _NARROW * values.real[:, :, None])
        near = near.reshape(len(good), -1)
        gains[good] = np.maximum(
            largest(_BASE[None, :], self._on_base), largest(near, self._sizes.squared(near))
        )
        return gains, abscissae


Complex = NDArray[np.complex128]
Loops = Callable[[Vector], StateSpace]

_GRID = np.concatenate([[0.0], np.logspace(-3, 5.5, 320)])
_ACROSS = np.array([-3.0, -1.5, -0.7, -0.3, -0.1, 0.0, 0.1, 0.3, 0.7, 1.5, 3.0])
_TALL = 0.6  # peaks above this share of the highest take part
_CLOSER = 6  # rounds of looks around a peak, each four times closer
_H = 1e-3  # of differences of the loop's matrices, which are smooth


class Peaks(NamedTuple):
    """Tall local maxima of |W_ij T_ij|, the highest first.

    height, omega [rad/s], channel (index into the weights): shape (K,) each.
    """

    height: Vector
    omega: Vector
    channel: NDArray[np.intp]


class PeakModel(NamedTuple):
    """1/height of K peaks around a point, to second order: base (K,), slope (K,n), bend (K,n,n)."""

    base: Vector
    slope: Vector
    bend: Vector

    def __call__(self, step: Vector) -> Vector:
        """1/height after a step (n,)."""
        return np.asarray(self.base + (self.slope + 0.5 * self.bend @ step) @ step)

    def slopes(self, step: Vector) -> Vector:
        """Its slopes there, (K,n)."""
        return np.asarray(self.slope + self.bend @ step)


def peaks(loop: StateSpace, weights: tuple[Weight, ...]) -> Peaks | None:
    """The tall peaks of all channels of T(s); None if it is unstable or no loop at all."""
    A, B, C, D = loop
    if not np.isfinite(A).all():
        return None
    poles, vectors = np.linalg.eig(A)
    if poles.real.max() >= 0.0:
        return None
    rows, columns = _places(weights)
    moved = np.linalg.solve(vectors, B.astype(complex))
    residues, through = (C @ vectors)[rows] * moved.T[columns], D[rows, columns]
    near = np.abs(poles.imag[:, None] + _ACROSS * poles.real[:, None]).ravel()
    omega = np.unique(np.concatenate([_GRID, near, np.abs(poles)]))
    sizes = np.abs((1.0 / (1j * omega[:, None] - poles)) @ residues.T + through)
    weight = sizes_of(weights)
    sizes *= np.sqrt(weight.squared(omega))
    padded = np.pad(sizes, ((1, 1), (0, 0)), constant_values=-np.inf)
    tall = sizes > 0.5 * _TALL * sizes.max()  # a narrow one may be higher on a finer grid
    k, channel = np.nonzero((sizes >= padded[:-2]) & (sizes > padded[2:]) & tall)
    height, top, each = sizes[k, channel], omega[k], np.arange(len(k))
    low, high = omega[np.maximum(k - 1, 0)], omega[np.minimum(k + 1, len(omega) - 1)]
    for _ in range(_CLOSER):
        x = np.linspace(low, high, 9, axis=1)
        T = (residues[channel][:, None] / (1j * x[..., None] - poles)).sum(-1)
        W = np.sqrt(weight.squared(x)[each, :, channel])
        y = np.abs(T + through[channel, None]) * W
        j = np.argmax(y, axis=1)
        better = y[each, j] > height
        height, top = np.where(better, y[each, j], height), np.where(better, x[each, j], top)
        low, high = x[each, np.maximum(j - 1, 0)], x[each, np.minimum(j + 1, 8)]
    if not len(height):  # no weight is reached at all
        return None
    order = np.argsort(-height, kind="stable")
    order = order[height[order] > _TALL * height.max()]
    return Peaks(height[order], top[order], channel[order])


def model(loops: Loops, weights: tuple[Weight, ...], at: Vector, of: Peaks) -> PeakModel:
    """The peaks ``of`` the loop at ``at``, to second order over its coordinates."""
    base, first, second = _derivatives(loops, at)
    rows, columns = _places(weights)
    i, j, s = rows[of.channel], columns[of.channel], 1j * of.omega
    A, B, C, D = base
    R = np.linalg.inv(s[:, None, None] * np.eye(len(A)) - A)  # (K,N,N)
    right = (R @ B.T[j][..., None])[..., 0]  # (K,N): R b
    left = (C[i][:, None] @ R)[:, 0]  # c R
    T = (C[i] * right).sum(-1) + D[i, j]

    def through(dA: Vector, dB: Vector, dC: Vector, dD: Vector) -> tuple[Complex, Complex]:
        """dA R b + db and dT, of each derivative (leading axes) and peak."""
        v = np.swapaxes(dA @ right.T + dB[..., j], -1, -2)
        return v, np.asarray((left * v + dC[..., i, :] * right).sum(-1) + dD[..., i, j])

    v, dT = through(*first)
    _, ddT = through(*second)
    u = left @ first[0] + first[2][:, i]  # (n,K,N): c R dA + dc
    uRv = np.moveaxis(np.moveaxis(u, 0, 1) @ R @ np.moveaxis(v, 0, -1), 0, -1)
    ddT = ddT + uRv + np.swapaxes(uRv, 0, 1)
    # over omega: dR = -j R R
    R_right, left_R = (R @ right[..., None])[..., 0], (left[:, None] @ R)[:, 0]
    T_w, T_ww = -1j * (left * right).sum(-1), -2 * (left_R * right).sum(-1)
    T_aw = -1j * ((u * R_right).sum(-1) + (left_R * v).sum(-1))
    # g = -ln |W T|
    g_a = -(dT / T).real.T
    g_ab = -np.moveaxis((ddT / T - dT[:, None] * dT[None] / T**2).real, -1, 0)
    g_aw = -(T_aw / T - dT * T_w / T**2).real.T
    g_ww = -(T_ww / T - (T_w / T) ** 2).real - sizes_of(weights).bend(of.omega, of.channel)
    moves = (g_ww > 0.0) & (of.omega > _GRID[1]) & (of.omega < _GRID[-1])
    g_ab -= g_aw[:, :, None] * g_aw[:, None] / np.where(moves, g_ww, np.inf)[:, None, None]
    inverse = 1.0 / of.height
    bend = inverse[:, None, None] * (g_ab + g_a[:, :, None] * g_a[:, None])
    return PeakModel(inverse, inverse[:, None] * g_a, bend)


def _places(weights: tuple[Weight, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.array([w.i - 1 for w in weights]), np.array([w.j - 1 for w in weights])


def _derivatives(loops: Loops, at: Vector) -> tuple[StateSpace, StateSpace, StateSpace]:
    """The loop's matrices, their first (n,...) and second (n,n,...) derivatives, by differences."""
    n = len(at)
    eye = _H * np.eye(n)
    one, other = np.triu_indices(n, 1)
    pairs = eye[one] + eye[other]
    stacked = loops(at + np.vstack([np.zeros((1, n)), eye, -eye, pairs, -pairs]))
    base, first, second = [], [], []
    for m in stacked:
        up, down, both = m[1 : n + 1], m[n + 1 : 2 * n + 1], m[2 * n + 1 :]
        bends = up - 2 * m[0] + down
        mixed = np.empty((n, n, *m.shape[1:]))
        mixed[range(n), range(n)] = bends
        cross = (both[: len(pairs)] + both[len(pairs) :] - 2 * m[0] - bends[one] - bends[other]) / 2
        mixed[one, other] = mixed[other, one] = cross
        base.append(m[0])
        first.append((up - down) / (2 * _H))
        second.append(mixed / _H**2)
    return tuple(base), tuple(first), tuple(second)  # type: ignore[return-value]
