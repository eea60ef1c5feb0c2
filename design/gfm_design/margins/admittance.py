"""Passivity, and stability on a grid, from a dq admittance that was measured or computed.

Nothing here needs a model of the converter. Y is its admittance at its terminal, the filter
capacitor, for small deviations in a dq frame that turns steadily at the grid's frequency: the
current into the converter is Y v. A grid of R and L behind an ideal voltage adds Z, so that the
loop is Z Y and its closed loop's poles are the zeros of det(I + Z Y).

Y may have unstable poles of its own: a grid-forming converter need not be stable on an ideal
voltage. The count of encirclements therefore does not use Z Y alone, but

    F(s) = det(I + Z Y) / det(I + Z_0 Y),

where Z_0 is a grid on which the converter is known to be stable, as that of the measurement is.
The poles of Y cancel, and the zeros of the denominator are in the left half plane: F turns around
0 as often, clockwise, as the closed loop on Z has unstable poles.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Response = NDArray[np.complex128]

_NEAR_REAL = math.pi / 4  # rad; beyond it an end of the locus does not lie on the real axis
_TURN = 2.0  # rad; a larger turn between two frequencies may hide one the other way


@dataclass(frozen=True)
class GridStability:
    """Whether a converter is stable on a grid, from its admittance."""

    stable: bool | None  #: None: the frequencies do not suffice to judge; ``reason`` says why
    unstable: int | None  #: how many poles of the closed loop are unstable; None as ``stable``
    margin: float  #: least distance of an eigenvalue of Z Y from -1 over the frequencies
    at_hz: float  #: where, Hz
    reason: str = ""  #: empty if ``stable`` is not None


def line_impedance(
    hz: Vector, R: float, L: float, omega_b: float, omega_g: float = 1.0
) -> Response:
    """The impedance of R and L in series in the dq frame, shape (K, 2, 2), p.u.

    Args:
        hz: frequencies in the dq frame, shape (K,), Hz.
        R, L: p.u.
        omega_b: base of the frequency, rad/s.
        omega_g: speed of the frame, p.u.
    """
    Z = np.zeros((len(hz), 2, 2), complex)
    Z[:, 0, 0] = Z[:, 1, 1] = R + 2j * np.pi * hz * L / omega_b
    Z[:, 0, 1], Z[:, 1, 0] = -omega_g * L, omega_g * L
    return Z


def passivity(Y: Response) -> Vector:
    """The least eigenvalue of Y + Y^H at each frequency, shape (K,), p.u.

    Where it is negative, a passive grid with a suitable resonance can be destabilised.

    Args:
        Y: shape (K, 2, 2), p.u.
    """
    return np.asarray(np.linalg.eigvalsh(Y + Y.conj().transpose(0, 2, 1))[:, 0])


def eigenloci(Y: Response, Z: Response) -> Response:
    """The eigenvalues of Z Y, each followed over the frequencies, shape (K, 2)."""
    found = np.linalg.eigvals(Z @ Y)
    for k in range(1, len(found)):
        kept = np.abs(found[k] - found[k - 1]).sum()
        if np.abs(found[k, ::-1] - found[k - 1]).sum() < kept:
            found[k] = found[k, ::-1]
    return np.asarray(found)


def grid_stability(hz: Vector, Y: Response, Z: Response, Z_stable: Response) -> GridStability:
    """Judge a converter on the grid Z by the generalised Nyquist criterion.

    Args:
        hz: frequencies in ascending order, Hz, shape (K,); they must reach from below the slowest
            mode to above the fastest resonance, and lie close where F turns.
        Y, Z: shape (K, 2, 2), p.u.
        Z_stable: of a grid on which the converter is known to be stable.
    """
    distance = np.abs(1.0 + np.linalg.eigvals(Z @ Y)).min(axis=1)
    k = int(np.argmin(distance))
    F = np.linalg.det(np.eye(2) + Z @ Y) / np.linalg.det(np.eye(2) + Z_stable @ Y)
    phase = np.unwrap(np.angle(F))
    turns = np.round(phase[[0, -1]] / np.pi).astype(int)
    off = np.abs(phase[[0, -1]] - turns * np.pi)
    jump = int(np.argmax(np.abs(np.diff(phase))))
    unstable = int(turns[0] - turns[1])
    reason = ""
    if abs(phase[jump + 1] - phase[jump]) > _TURN:
        reason = f"too few points between {hz[jump]:.4g} and {hz[jump + 1]:.4g} Hz"
    elif off[0] > _NEAR_REAL:
        reason = f"the locus does not begin at {hz[0]:.4g} Hz; measure from a lower frequency"
    elif off[1] > _NEAR_REAL:
        reason = f"the locus does not end at {hz[-1]:.4g} Hz; measure to a higher frequency"
    elif unstable < 0:
        reason = "the locus turns the wrong way; measure more points, over a wider range"
    of = float(distance[k]), float(hz[k])
    if reason:
        return GridStability(None, None, *of, reason)
    return GridStability(unstable == 0, unstable, *of)
