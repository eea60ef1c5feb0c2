"""Small signals: the plant linearised at an operating point, and the modes of the loop it closes.

The plant's matrices come from ``gfm_plant.model.f`` and ``g`` by complex step, which takes no
difference and is exact to rounding. The sampled loop is exact for the linearised plant too: u is
held over the loop delay (whole samples and a fraction: the modified z-transform), the sensors'
low-pass belongs to the plant that is held, and the law steps as the kernel steps it. Quantisation,
noise and limits are left out. All in p.u. and s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.operating_point import OperatingPoint
from gfm_plant.model import N_X, V_DC, f, g
from gfm_plant.records import PlantRecord
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.law import Law
from gfm_runtime.realisation import LawStateSpace, realise
from gfm_runtime.signals import NU, NY
from gfm_runtime.tustin import OMEGA_COLUMN, OMEGA_ROW, DiscreteLaw

Matrix = NDArray[np.float64]

_STEP = 1e-30  # complex step
_NUDGE = 1e-6  # central differences, for the error map alone: it is compiled for real numbers
_GONE = 1e-9  # |z| below this is gone within a tick: an emptied delay line, no mode
_MEASURED = [0, 1, 3, 4]  # the outputs that pass the sensors; omega_u does not


@dataclass(frozen=True)
class LinearPlant:
    """dx/dt = A x + B u + B_d d,  y = C x: deviations from the operating point.

    Shapes: A (n,n), B (n,3), B_d (n,2), C (5,n). The first eight states are the plant's; one more
    is the integral of a regulated DC source, four more are band-limited sensors. y is what the
    controller is given; its row omega_u is 0, since a law is fed its own omega_u.
    """

    A: Matrix
    B: Matrix
    B_d: Matrix
    C: Matrix


@dataclass(frozen=True)
class LinearLaw:
    """The law around its operating point: x' = A x + B y + B_r r,  u = C x + D y + D_r r.

    x' is dx/dt or the next x. The omega_u loop is closed and the error map is in the matrices, so
    y and r are plain measurements and references. Rows that are not in force have no states.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    B_r: Matrix
    D_r: Matrix


@dataclass(frozen=True)
class Mode:
    """One real mode, or one complex pair: exp(sigma t) cos(2 pi frequency_hz t)."""

    sigma: float  # 1/s, positive grows
    frequency_hz: float  # 0 for a real mode

    @property
    def ratio(self) -> float:
        """Damping ratio, -sigma over the distance from s = 0."""
        size = float(np.hypot(self.sigma, 2 * np.pi * self.frequency_hz))
        return -self.sigma / size if size else 0.0


def linearise_plant(
    par: PlantRecord, op: OperatingPoint, omega_g: float = 1.0, V_g: float = 1.0
) -> LinearPlant:
    """The plant with its DC source and sensors, at rest at ``op`` on a grid of omega_g and V_g."""
    r = par[0]
    at = np.concatenate([op.x, op.u, [omega_g, V_g]])
    slopes = np.empty((N_X + NY, len(at)))
    for j in range(len(at)):
        z = at.astype(complex)
        z[j] += 1j * _STEP
        x, u, d = np.split(z, [N_X, N_X + NU])
        slopes[:, j] = np.concatenate([f(x, u, d, par), g(x, u)]).imag / _STEP
    regulated, sensors = int(r["i_u_gain"] == 0.0), 4 * int(r["filtered"])
    n, s = N_X + regulated, slice(N_X + regulated, N_X + regulated + sensors)
    A, C = np.zeros((n + sensors, n + sensors)), np.zeros((NY, n + sensors))
    B, B_d = np.zeros((n + sensors, NU)), np.zeros((n + sensors, 2))
    A[:N_X, :N_X], B[:N_X], B_d[:N_X] = np.split(slopes[:N_X], [N_X, N_X + NU], axis=1)
    C[_MEASURED, :N_X] = slopes[N_X:][_MEASURED, :N_X]
    if regulated:  # i_dc = k_p (1 - v_dc) + its integral, in place of i_u
        A[V_DC, V_DC] -= r["k_p"] * B[V_DC, 0]
        A[V_DC, N_X], A[N_X, V_DC] = B[V_DC, 0], -r["k_i"]
        B[:, 0] = 0.0
    if sensors:
        A[s, :n], A[s, s] = r["omega_s"] * C[_MEASURED, :n], -r["omega_s"] * np.eye(4)
        C[:] = 0.0
        C[_MEASURED, s] = np.eye(4)
    C[_MEASURED] *= r["gain"][:, None]
    return LinearPlant(A, B, B_d, C)


def linearise_law(
    law: Law, ss: DiscreteLaw | LawStateSpace, op: OperatingPoint, ref: Matrix, dc_control: bool
) -> LinearLaw:
    """A law, discrete or continuous, around ``op``; ``dc_control`` says that row 1 is in force."""
    slopes = error_map_slopes(law.error_map, law.error_parameters, op.y, ref)
    return closed_law(ss, slopes, dc_control)


def closed_law(
    ss: DiscreteLaw | LawStateSpace, slopes: tuple[Matrix, Matrix], dc_control: bool
) -> LinearLaw:
    """State space with the error map's slopes and the omega_u loop in it.

    The matrices may have leading axes, one entry a law.
    """
    mapped_r, mapped_y = slopes
    # one matrix for (y, r), so that the omega_u loop is closed through both at once
    B = ss.B_r @ mapped_r + ss.B_y @ mapped_y
    D = ss.D_r @ mapped_r + ss.D_y @ mapped_y
    D[..., NY:] += ss.D_u0
    # omega_u = c x + d (y, r) + D omega_u
    gain = 1.0 / (1.0 - D[..., [OMEGA_ROW], :][..., [OMEGA_COLUMN]])
    b, d = B[..., [OMEGA_COLUMN]] * gain, D[..., [OMEGA_COLUMN]] * gain
    B[..., OMEGA_COLUMN], D[..., OMEGA_COLUMN] = 0.0, 0.0
    c_omega, d_omega = ss.C[..., [OMEGA_ROW], :], D[..., [OMEGA_ROW], :].copy()
    A, B, C, D = ss.A + b @ c_omega, B + b @ d_omega, ss.C + d @ c_omega, D + d @ d_omega
    k = [i for i, row in enumerate(ss.rows) if dc_control or row != 0]
    A, B, C = A[..., k, :][..., k], B[..., k, :], C[..., k]
    return LinearLaw(A, B[..., :NY], C, D[..., :NY], B[..., NY:], D[..., NY:])


def error_map_slopes(
    error_map: str, parameters: Sequence[float], y: Matrix, ref: Matrix
) -> tuple[Matrix, Matrix]:
    """Slopes of the mapped r and of the mapped y over (y, r), both (5,10)."""
    if error_map == "linear":
        zero, eye = np.zeros((NY, NY)), np.eye(NY)
        return np.hstack([zero, eye]), np.hstack([eye, zero])
    impedance = np.zeros(2)
    impedance[: len(parameters)] = parameters
    mapped = np.empty((2, 2, NY, 2 * NY))  # up or down, r or y, component, by which input
    for k, sign in enumerate((1.0, -1.0)):
        for j in range(2 * NY):
            inputs = np.concatenate([y, ref])
            inputs[j] += sign * _NUDGE
            z, r = inputs[:NY], inputs[NY:]
            map_errors(ERROR_MAPS[error_map], impedance, r, z)
            mapped[k, 0, :, j], mapped[k, 1, :, j] = r, z
    slopes = (mapped[0] - mapped[1]) / (2 * _NUDGE)
    return slopes[0], slopes[1]


def hold(A: Matrix, B: Matrix, T: float) -> tuple[Matrix, Matrix]:
    """exp(A T) and the integral of exp(A t) B over (0, T): the plant over a held input."""
    n, m = B.shape
    M = np.zeros((n + m, n + m))
    M[:n, :n], M[:n, n:] = A * T, B * T
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(M).sum(axis=1).max(), 1e-300)))) + 2)
    M /= 2.0**halvings
    term = out = np.eye(n + m)
    for k in range(1, 16):  # the norm is at most 1/4: the 16th term is below 1e-22
        term = term @ M / k
        out = out + term
    for _ in range(halvings):
        out = out @ out
    return out[:n, :n], out[:n, n:]


def sampled_loop(par: PlantRecord, plant: LinearPlant, law: LinearLaw) -> Matrix:
    """The loop's matrix from tick to tick; state: plant, law, u[k-1], u[k-2], ..."""
    r = par[0]
    old = r["steps_old"] * r["h_old"]  # for so long u[k-delay-1] acts, then u[k-delay]
    new = r["T_s"] - old
    to_switch, by_old = hold(plant.A, plant.B, old)
    to_end, by_new = hold(plant.A, plant.B, new)
    delay, n, m = int(r["delay"]), len(plant.A), len(law.A)
    oldest = delay + (old > 0.0)
    size = n + m + NU * oldest
    lines = np.zeros((NU * (oldest + 1), size))  # u[k], u[k-1], ... as maps of the state
    lines[:NU, :n], lines[:NU, n : n + m] = law.D @ plant.C, law.C
    lines[NU:, n + m :] = np.eye(NU * oldest)
    out = np.zeros((size, size))
    out[:n, :n] = to_end @ to_switch
    out[:n] += by_new @ lines[NU * delay : NU * (delay + 1)]
    if old > 0.0:
        out[:n] += to_end @ by_old @ lines[NU * oldest :]
    out[n : n + m, :n], out[n : n + m, n : n + m] = law.B @ plant.C, law.A
    out[n + m :] = lines[: NU * oldest]
    return out


def loop_modes(
    par: PlantRecord,
    law: DiscreteLaw,
    op: OperatingPoint,
    ref: Matrix,
    omega_g: float = 1.0,
    V_g: float = 1.0,
) -> list[Mode]:
    """Modes of the sampled closed loop at ``op``, the least damped (largest sigma) first.

    Args:
        par: the plant's parameters, from ``gfm_plant.make_plant``; its T_s must be the law's.
        law: the law at its sampling time.
        op: from ``gfm_design.model.operating_point`` with the same par, law, ref and grid.
        ref: references (V_dcref, P_ref, omega_g, Q_ref, V_ref), shape (5,), p.u.
        omega_g, V_g: the grid, p.u.
    """
    plant = linearise_plant(par, op, omega_g, V_g)
    linear = linearise_law(law.law, law, op, ref, par[0]["i_u_gain"] != 0.0)
    z = np.linalg.eigvals(sampled_loop(par, plant, linear)).astype(complex)
    return _modes(np.log(z[np.abs(z) > _GONE]) / law.T_s)


def ideal_modes(
    par: PlantRecord,
    law: Law,
    op: OperatingPoint,
    ref: Matrix,
    omega_g: float = 1.0,
    V_g: float = 1.0,
) -> list[Mode]:
    """As ``loop_modes`` for the continuous law: no sampling and no delay, whatever par says."""
    plant = linearise_plant(par, op, omega_g, V_g)
    c = linearise_law(law, realise(law), op, ref, par[0]["i_u_gain"] != 0.0)
    A = plant.A + plant.B @ c.D @ plant.C
    loop = np.block([[A, plant.B @ c.C], [c.B @ plant.C, c.A]])
    return _modes(np.linalg.eigvals(loop).astype(complex))


def _modes(s: NDArray[np.complex128]) -> list[Mode]:
    found = [Mode(float(v.real), float(v.imag / (2 * np.pi))) for v in s if v.imag >= 0.0]
    return sorted(found, key=lambda mode: -mode.sigma)
