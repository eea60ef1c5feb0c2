"""Disk margins of all channels at once: gain and phase may change in each on its own.

alpha = 1/||(S - T)/2||_mu, skew 0, after P. Seiler, A. Packard and P. Gahinet, "An introduction
to disk margins", IEEE Control Systems 40(5), 2020. Each channel may be multiplied by any factor
within the disk through (2 - alpha)/(2 + alpha) and (2 + alpha)/(2 - alpha), all at the same time.

mu of a diagonal complex uncertainty is bounded from above by scaling, sigma_max(D H D^-1), which
is exact for up to three channels at the best D. The reported value is therefore a margin that the
loop has at least. ``full`` ignores the structure (D = 1): it is smaller, but needs no
grid of frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.locus import Locus
from gfm_design.norms.hinf import hinf_norm

Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

_POWERS = ((1, 12), (4, 30), (16, 60), (64, 100))  # of the norm, and rounds for each
_ROUGH = _POWERS[:1]
_NEAR = 0.9
_LOOKS = 6


@dataclass(frozen=True)
class DiskMargin:
    """Multivariable disk margin at one cut."""

    alpha: float  #: at least this, at most 2
    frequency_hz: float  #: where the bound is smallest, Hz
    full: float  #: the guaranteed smaller one that ignores the structure

    @property
    def gain(self) -> tuple[float, float]:
        """Factors between which the gains of all channels may vary at once."""
        low = (2 - self.alpha) / (2 + self.alpha)
        return low, 1 / low if low > 0.0 else np.inf

    @property
    def phase_deg(self) -> float:
        """Phase by which every channel may lag or lead, all at once."""
        return float(np.degrees(2 * np.arctan(self.alpha / 2)))


def disk_margin(locus: Locus) -> DiskMargin:
    """The disk margin of all channels of a locus at once."""
    m = len(locus.channels)
    full = hinf_norm(locus.A, locus.B, locus.C, 0.5 * np.eye(m), locus.T_s).gain
    omega, H = locus.sampled()
    rough = mu_bound(H, _ROUGH)
    top, at = _largest(omega, H, rough, 0.0)
    # the maximum may lie between two frequencies: refine around every one that comes near it
    around = np.concatenate([[0.0], rough, [0.0]])
    summits = (rough >= around[:-2]) & (rough >= around[2:]) & (rough > _NEAR * top)
    for k in [int(k) for k in np.flatnonzero(summits)]:
        low, high = omega[max(k - 1, 0)], omega[min(k + 1, len(omega) - 1)]
        for _ in range(_LOOKS):
            w = np.linspace(low, high, 9)
            there = locus(w)
            found, best = _largest(w, there, mu_bound(there, _ROUGH), top)
            if found <= top:
                break
            top, at = found, best
            low, high = max(low, at - (w[1] - w[0])), min(high, at + (w[1] - w[0]))
    return DiskMargin(1.0 / top, at / (2 * np.pi), 1.0 / full)


def _largest(omega: Matrix, H: Response, rough: Matrix, top: float) -> tuple[float, float]:
    """The largest bound above ``top`` and its frequency; (top, nan) if there is none.

    A rough bound is a bound too, and so is that by the scaling of another frequency: one that is
    below the largest one found needs no refinement.
    """
    at, rough = np.nan, rough.copy()
    while rough[k := int(np.argmax(rough))] > top:
        bounds, scalings = _scaled(H[[k]], _POWERS)
        if bounds[0] > top:
            top, at = float(bounds[0]), float(omega[k])
        rough[k], d = 0.0, scalings[0]
        left = rough > top
        others = np.linalg.norm(H[left] * d[:, None] / d, 2, axis=(1, 2))
        rough[left] = np.minimum(rough[left], others)
    return top, at


def mu_bound(H: Response, powers: tuple[tuple[int, int], ...] = _POWERS) -> Matrix:
    """Upper bound of mu(H) for diagonal complex uncertainty, H (k,m,m), one a frequency.

    D evens out the rows and columns of H^H H to a power, Osborne's balancing for the first:
    that minimises a norm which tends to sigma_max as the power grows. Any D gives a bound; the
    smallest one met is returned.
    """
    return _scaled(H, powers)[0]


def _scaled(H: Response, powers: tuple[tuple[int, int], ...]) -> tuple[Matrix, Matrix]:
    """The bounds (k,) of ``mu_bound`` and the D (k,m) of each."""
    log_d, best = np.zeros(H.shape[:2]), np.ones(H.shape[:2])
    bound = np.linalg.norm(H, 2, axis=(1, 2))
    if H.shape[1] == 1:
        return bound, best
    tiny = 1e-300
    for power, rounds in powers:
        for _ in range(rounds):
            d = np.exp(log_d)
            u, s, vh = np.linalg.svd(H * d[:, :, None] / d[:, None, :])
            better = s[:, 0] < bound
            bound, best[better] = np.minimum(bound, s[:, 0]), d[better]
            share = (s / np.maximum(s[:, :1], tiny)) ** (2 * power)
            rows = (np.abs(u) ** 2 * share[:, None, :]).sum(axis=2)
            columns = (np.abs(vh) ** 2 * share[:, :, None]).sum(axis=1)
            log_d += np.log((columns + tiny) / (rows + tiny)) / (4 * power)
            log_d = np.clip(log_d - log_d[:, :1], -40.0, 40.0)
    return bound, best
