"""A quick look at gamma for a search that looks thousands of times.

The loop is taken apart into its modes once; all channels are then evaluated together on a grid
that follows the modes, with points across every narrow resonance, and looked at again around each
channel's best point. The result is a lower bound close to the norm; what a search ends with is
confirmed by ``gfm_design.hinf``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gfm_design.performance import StateSpace, Weight

Vector = NDArray[np.float64]

_BASE = np.concatenate(
    [[1e-3], np.logspace(-2, 1, 60), np.logspace(1, 3, 80), np.logspace(3, 5, 60)]
)
_SECOND_LOOK = np.linspace(0.0, 1.0, 12)
_ACROSS = np.array([-3.0, -1.5, -0.7, -0.3, -0.1, 0.0, 0.1, 0.3, 0.7, 1.5, 3.0])


class Screen:
    """Screens closed loops against one set of weights."""

    def __init__(self, weights: tuple[Weight, ...]) -> None:
        self._weights = weights
        self._rows = [w.i - 1 for w in weights]
        self._columns = [w.j - 1 for w in weights]
        self._on_base = self._gain(_BASE)

    def __call__(self, loop: StateSpace) -> tuple[float, float]:
        """(largest weighted gain, spectral abscissa in 1/s); the gain is inf if unstable."""
        A, B, C, D = loop
        values, vectors = np.linalg.eig(A)
        abscissa = float(values.real.max())
        if abscissa >= 0.0:
            return np.inf, abscissa
        residues = (C @ vectors)[self._rows].T * np.linalg.solve(vectors, B.astype(complex))[
            :, self._columns
        ]
        through = D[self._rows, self._columns]
        pairs = values[values.imag > 0.0]
        near = np.abs(pairs.imag[:, None] + _ACROSS * pairs.real[:, None]).ravel()
        omega = np.concatenate([_BASE, near, np.abs(values)])
        weight = np.concatenate([self._on_base, self._gain(omega[len(_BASE) :])])

        def gains(omega: Vector, weight: Vector) -> Vector:
            return np.abs((1.0 / (1j * omega[:, None] - values)) @ residues + through) * weight

        found = gains(omega, weight)
        order = np.argsort(omega)
        worst = float(found.max())
        # a second look between the neighbours of each channel's best point
        omega = omega[order]
        tops = np.clip(np.argmax(found[order], axis=0), 1, len(omega) - 2)
        low, high = omega[tops - 1], omega[tops + 1]
        between = (low + (high - low) * _SECOND_LOOK[:, None]).ravel()
        return max(worst, float(gains(between, self._gain(between)).max())), abscissa

    def _gain(self, omega: Vector) -> Vector:
        return np.stack([np.abs(w(1j * omega)) for w in self._weights], axis=1)
