"""Gain and phase margins of one loop, all others closed, from the crossings of its locus.

A factor k e^(-j phi) on a stable loop first meets the unit circle at a crossing: of the real axis
for a gain alone, of the unit circle for a phase alone. The nearest crossing is therefore the
margin, even if the loop is stable again beyond it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.locus import Locus

Vector = NDArray[np.float64]

_ROUNDS = 60
_SAME = 1e-15  # relative distance of two values of a crossing
_NO_LIMIT = 1e6  # a larger gain factor is due to rounding


@dataclass(frozen=True)
class GainPhase:
    """Margins of one loop."""

    #: gain_low, gain_high: factors between which the loop gain may go; 0 and inf: no limit
    gain_low: float
    #: gain_low_hz, gain_high_hz: frequency of the mode that becomes unstable there, Hz
    gain_low_hz: float
    gain_high: float
    gain_high_hz: float
    phase_deg: float  #: the smallest lag or lead that makes the loop unstable; inf: there is none
    phase_hz: float  #: frequency of the mode that becomes unstable then, Hz
    disk: float  #: disk margin of this loop alone (skew 0), at most 2


def gain_phase(locus: Locus, omega: Vector, H: NDArray[np.complex128], k: int) -> GainPhase:
    """Margins of the locus' k-th channel; omega and H from ``locus.sampled()``."""

    alone = locus.of(k)

    def at(w: Vector) -> NDArray[np.complex128]:
        return alone(w)[:, 0, 0]

    h = H[:, k, k]
    # at rest and at the Nyquist frequency H is real: a mode on the real axis crosses there
    ends = omega[[0, -1]]
    real = np.concatenate([ends, _crossings(lambda w: at(w).imag, omega[1:-1], h.imag[1:-1])])
    h_real = at(real).real
    with np.errstate(divide="ignore"):
        factors = (h_real + 0.5) / (h_real - 0.5)
    low, low_at = _nearest(factors, real, (1 / _NO_LIMIT, 1.0), np.max, 0.0)
    high, high_at = _nearest(factors, real, (1.0, _NO_LIMIT), np.min, np.inf)
    unit = _crossings(lambda w: at(w).real, omega, h.real)
    H_unit = at(unit)
    phases = np.abs(np.angle((H_unit - 0.5) / (H_unit + 0.5), deg=True))
    phase, phase_at = _nearest(phases, unit, (0.0, np.inf), np.min, np.inf)
    return GainPhase(
        low,
        low_at / (2 * np.pi),
        high,
        high_at / (2 * np.pi),
        phase,
        phase_at / (2 * np.pi),
        1.0 / _peak(at, omega, np.abs(h)),
    )


def _nearest(
    values: Vector,
    omega: Vector,
    between: tuple[float, float],
    choose: Callable[[Vector], float],
    otherwise: float,
) -> tuple[float, float]:
    inside = (values > between[0]) & (values < between[1])
    if not inside.any():
        return otherwise, np.nan
    value = float(choose(values[inside]))
    return value, float(omega[np.flatnonzero(values == value)[0]])


def _crossings(f: Callable[[Vector], Vector], omega: Vector, values: Vector) -> Vector:
    """Where f changes its sign between two of omega, all at once by the Illinois method, rad/s."""
    k = np.flatnonzero(np.sign(values[1:]) * np.sign(values[:-1]) < 0)
    (far, last), (f_far, f_last) = (np.array([of[k], of[k + 1]]) for of in (omega, values))
    for _ in range(_ROUNDS):
        if not len(k):
            break
        found = last - f_last * (last - far) / (f_last - f_far)
        f_found = f(found)
        crossed = np.sign(f_found) != np.sign(f_last)
        far, f_far = np.where(crossed, last, far), np.where(crossed, f_last, f_far / 2)
        steady = np.abs(found - last) <= _SAME * found
        last, f_last = found, f_found
        if steady.all():
            break
    return last


def _peak(at: Callable[[Vector], NDArray[np.complex128]], omega: Vector, size: Vector) -> float:
    """The largest |H|, refined repeatedly around the best point of the grid."""
    k = int(np.argmax(size))
    low, high = omega[max(k - 1, 0)], omega[min(k + 1, len(omega) - 1)]
    best = float(size[k])
    for _ in range(8):
        w = np.linspace(low, high, 11)
        found = np.abs(at(w))
        j = int(np.argmax(found))
        best = max(best, float(found[j]))
        low, high = w[max(j - 1, 0)], w[min(j + 1, 10)]
    return best
