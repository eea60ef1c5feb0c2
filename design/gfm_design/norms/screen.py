"""A fast estimate of gamma for a search that needs it thousands of times.

It decomposes the loops of a whole population into their modes at once, and evaluates all channels
on a grid that follows the modes, with points across every narrow resonance. The result
is a lower bound close to the norm. ``tuning.polish`` works on the peaks themselves, and
``gfm_design.norms.hinf`` confirms the result of a search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gfm_design.norms.performance import StateSpace, Weight
from gfm_design.norms.weights import Sizes

Vector = NDArray[np.float64]

_BASE = np.concatenate(  # rad/s; as good as 0 and infinity at the ends, where many laws are worst
    [[1e-6, 1e-3], np.logspace(-2, 0, 10), np.logspace(0.05, 3, 70), np.logspace(3.1, 5, 20), [1e7]]
)
_ACROSS = np.array([-2.0, -0.8, -0.3, 0.0, 0.3, 0.8, 2.0])  # half widths around a resonance


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

        near = np.abs(values.imag[:, :, None] + _ACROSS * values.real[:, :, None])
        near = near.reshape(len(good), -1)
        gains[good] = np.maximum(
            largest(_BASE[None, :], self._on_base), largest(near, self._sizes.squared(near))
        )
        return gains, abscissae
