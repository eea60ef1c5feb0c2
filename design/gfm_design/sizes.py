"""|W(j omega)| of all weights at once, as ratios of polynomials in omega^2."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_design.performance import Weight

Vector = NDArray[np.float64]


class Sizes:
    """Sizes of some weights."""

    def __init__(self, weights: Sequence[Weight]) -> None:
        self._num, self._den = (
            _stacked([_squared_size(c) for c in side])
            for side in ([w.num for w in weights], [w.den for w in weights])
        )

    def squared(self, omega: Vector) -> Vector:
        """|W|^2 at omega [rad/s] of any shape; the weights are a last axis."""
        y = (omega * omega)[..., None]
        num, den = (y ** np.arange(c.shape[1]) @ c.T for c in (self._num, self._den))
        return np.asarray(num / den)

    def bend(self, omega: Vector, which: NDArray[np.intp]) -> Vector:
        """Second derivative of ln |W| over omega, at omega (K,) of the weights ``which`` (K,)."""
        y, out = omega * omega, np.zeros(len(omega))
        for sign, c in ((0.5, self._num[which]), (-0.5, self._den[which])):
            k = np.arange(c.shape[1])
            powers = [y[:, None] ** np.maximum(k - m, 0) for m in range(3)]
            factors = [np.ones_like(k), k, k * (k - 1)]
            p, dp, ddp = ((c * f * q).sum(axis=1) for f, q in zip(factors, powers, strict=True))
            out += sign * (2 * dp / p + 4 * y * (ddp / p - (dp / p) ** 2))
        return out


def _squared_size(c: tuple[float, ...]) -> Vector:
    """|c(j omega)|^2 as a polynomial in omega^2, ascending."""
    ascending = np.asarray(c)[::-1]
    signs = (-1.0) ** np.arange(len(c))
    return np.convolve(ascending, ascending * signs)[::2] * signs


def _stacked(polynomials: list[Vector]) -> Vector:
    out = np.zeros((len(polynomials), max(len(p) for p in polynomials)))
    for row, p in zip(out, polynomials, strict=True):
        row[: len(p)] = p
    return out
