"""The margins of a loop that follow from H = (S - T)/2 on the unit circle.

S is the sensitivity of the closed loop at u or at y, T = I - S. For one loop, with all others
closed, L = (1/2 - H)/(1/2 + H): the gain of L is 1 where Re H = 0, its phase 0 or 180 degrees
where Im H = 0, and the disk margin (skew 0) is 1/max |H|. The frequencies are refined until the
locus between two of them is straight to a per cent, from a grid that follows the closed loop's
poles up to the Nyquist frequency.

Gain and phase margins: a factor k e^(-j phi) on a stable loop first meets the unit circle at a
crossing, of the real axis for a gain alone, of the unit circle for a phase alone. The nearest
crossing is therefore the margin, even if the loop is stable again beyond it.

Disk margins of all channels at once, where gain and phase may change in each on its own:
alpha = 1/||(S - T)/2||_mu, skew 0, after P. Seiler, A. Packard and P. Gahinet, "An introduction
to disk margins", IEEE Control Systems 40(5), 2020. Each channel may be multiplied by any factor
within the disk through (2 - alpha)/(2 + alpha) and (2 + alpha)/(2 - alpha), all at the same time.

mu of a diagonal complex uncertainty is bounded from above by scaling, sigma_max(D H D^-1), which
is exact for up to three channels at the best D. The reported value is therefore a margin that the
loop has at least. ``full`` ignores the structure (D = 1): it is smaller, but needs no
grid of frequencies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import GONE, ClosedLoop, Responses, frequencies_near
from gfm_design.norms.hinf import hinf_norm

Matrix = NDArray[np.float64]
Response = NDArray[np.complex128]

_LOWEST = 1e-3  # rad/s; below it H hardly changes, unless the loop has a pole there
_STRAIGHT = 0.01
_ROUNDS = 12
_APART = 1e-9  # relative distance of two frequencies


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
        s = np.log(poles[np.abs(poles) > GONE].astype(complex)) / self.T_s
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


_ROUNDS_OF_CROSSING = 60
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


def gain_phase(locus: Locus, omega: Matrix, H: Response, k: int) -> GainPhase:
    """Margins of the locus' k-th channel; omega and H from ``locus.sampled()``."""
    alone = locus.of(k)

    def at(w: Matrix) -> Response:
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
    low_at, high_at, phase_at = (w / (2 * np.pi) for w in (low_at, high_at, phase_at))
    disk = 1.0 / _peak(at, omega, np.abs(h))
    return GainPhase(low, low_at, high, high_at, phase, phase_at, disk)


def _nearest(
    values: Matrix,
    omega: Matrix,
    between: tuple[float, float],
    choose: Callable[[Matrix], float],
    otherwise: float,
) -> tuple[float, float]:
    inside = (values > between[0]) & (values < between[1])
    if not inside.any():
        return otherwise, np.nan
    value = float(choose(values[inside]))
    return value, float(omega[np.flatnonzero(values == value)[0]])


def _crossings(f: Callable[[Matrix], Matrix], omega: Matrix, values: Matrix) -> Matrix:
    """Where f changes its sign between two of omega, all at once by the Illinois method, rad/s."""
    k = np.flatnonzero(np.sign(values[1:]) * np.sign(values[:-1]) < 0)
    (far, last), (f_far, f_last) = (np.array([of[k], of[k + 1]]) for of in (omega, values))
    for _ in range(_ROUNDS_OF_CROSSING):
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


def _peak(at: Callable[[Matrix], Response], omega: Matrix, size: Matrix) -> float:
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
