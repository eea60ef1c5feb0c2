"""|W(j omega)| of all weights at once, as ratios of polynomials in omega^2."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.performance import Weight
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml

Vector = NDArray[np.float64]


class Sizes:
    """Magnitudes |W(j omega)| of several weights."""

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
    if not isinstance(value, list) or not 1 <= len(value) <= _DEGREE + 1:
        raise ValueError(f"{where}: must be a list of 1 to {_DEGREE + 1} numbers")
    if not all(isinstance(c, (int, float)) and not isinstance(c, bool) for c in value):
        raise ValueError(f"{where}: must be a list of 1 to {_DEGREE + 1} numbers")
    try:
        return tuple(float(c) for c in value)
    except OverflowError:
        raise ValueError(f"{where}: a number is too large") from None
