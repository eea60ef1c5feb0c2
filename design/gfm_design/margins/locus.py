"""H = (S - T)/2 on the unit circle, from which all margins of a loop follow.

S is the sensitivity of the closed loop at u or at y, T = I - S. For one loop, with all others
closed, L = (1/2 - H)/(1/2 + H): the gain of L is 1 where Re H = 0, its phase 0 or 180 degrees
where Im H = 0, and the disk margin (skew 0) is 1/max |H|. The frequencies are refined until the
locus between two of them is straight to a per cent, from a grid that follows the closed loop's
poles up to the Nyquist frequency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop, Responses, frequencies_near

Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

_LOWEST = 1e-3  # rad/s; below it H hardly changes, unless the loop has a pole there
_STRAIGHT = 0.01
_ROUNDS = 12
_APART = 1e-9  # relative distance of two frequencies
_GONE = 1e-9  # poles with a smaller |z| are those of the delay lines: z = 0 but for rounding


@dataclass(frozen=True)
class Locus:
    """H of the channels of one cut as a stable discrete state space.

    Shapes: A (n,n), B (n,m), C (m,n); H = C (zI - A)^-1 B + I/2. ``channels`` are their indices
    in u or y, without those that the loop does not use.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    T_s: float
    channels: tuple[int, ...]

    @cached_property
    def _responses(self) -> Responses:
        return Responses(self.A, self.B, self.C, 0.5 * np.eye(len(self.channels)))

    def __call__(self, omega: Matrix) -> Response:
        """H at omega [rad/s], shape (len(omega), m, m)."""
        return self._responses(np.exp(1j * omega * self.T_s))

    def of(self, k: int) -> Locus:
        """That of the k-th channel alone, shape (len(omega), 1, 1), all others closed."""
        return replace(self, B=self.B[:, [k]], C=self.C[[k]], channels=self.channels[k : k + 1])

    def sampled(self) -> tuple[Matrix, Response]:
        """(omega, H(omega)) from 0 to the Nyquist frequency, as fine as the locus needs."""
        top = np.pi / self.T_s
        poles = np.linalg.eigvals(self.A)
        s = np.log(poles[np.abs(poles) > _GONE].astype(complex)) / self.T_s
        near, base = frequencies_near(s), np.geomspace(_LOWEST, top, 200)
        omega = np.unique(np.concatenate([[0.0, top], base, near[near < top]]))
        omega = omega[np.diff(omega, prepend=-1.0) > _APART * omega]  # modes may be equal
        H = self(omega)
        for _ in range(_ROUNDS):
            # halves by ratio, as poles lie; the first interval begins at 0
            middle = np.sqrt(omega[1:] * omega[:-1])
            middle[0] = 0.5 * omega[1]
            found = self(middle)
            bend = np.abs(found - 0.5 * (H[1:] + H[:-1])).max(axis=(1, 2))
            bent = bend > _STRAIGHT * np.maximum(np.abs(found).max(axis=(1, 2)), 0.5)
            if not bent.any():
                break
            omega = np.concatenate([omega, middle[bent]])
            order = np.argsort(omega)
            omega, H = omega[order], np.concatenate([H, found[bent]])[order]
        return omega, H


def locus_at_u(loop: ClosedLoop) -> Locus:
    """H at u: all loops are cut at the commands, before their delay."""
    p, c = loop.held, loop.controller
    B = np.vstack([p.B, np.zeros((len(c.A), p.B.shape[1]))])
    return _locus(loop, B, np.hstack([c.D @ p.C, c.C]), loop.commands)


def locus_at_y(loop: ClosedLoop) -> Locus:
    """H at y: all loops are cut at the measurements."""
    p, c = loop.held, loop.controller
    C = np.hstack([p.C, np.zeros((p.C.shape[0], len(c.A)))])
    return _locus(loop, np.vstack([p.B @ c.D, c.B]), C, loop.measurements)


def _locus(loop: ClosedLoop, B: Matrix, C: Matrix, channels: tuple[int, ...]) -> Locus:
    k = list(channels)
    if loop.T_s is None:
        raise ValueError("the margins are those of a sampled loop; sample it first")
    return Locus(loop.A, B[:, k], C[k], loop.T_s, channels)
