"""Tustin's discretisation of a whole law, and the checks that let it into the kernel.

    x[k+1] = A x[k] + B_r r[k] + B_y y[k]
    u[k]   = u_0 + C x[k] + D_r r[k] + D_y y[k]

Column 3 of B_y and D_y multiplies the law's own omega_u[k] *of the same tick*: the kernel solves
the scalar loop omega_u = (...) + D_y[1,2] omega_u in closed form, so no hidden delay enters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.errors import LawError
from gfm_runtime.law import Law, cell_name
from gfm_runtime.realise import LawStateSpace, realise
from gfm_runtime.signals import NU, NY

Matrix = NDArray[np.float64]

OMEGA_ROW, OMEGA_COLUMN = 1, 2
_ON_CIRCLE = 1e-9  # |z| beyond 1 + this is unstable; an integrator sits at 1 to rounding


@dataclass(frozen=True)
class DiscreteLaw:
    """A law at one sampling time; shapes and units as in ``LawStateSpace``, T_s in s.

    W (n,3) is the anti-windup gain: x is moved by W (u_clamped - u_raw) before it steps.
    The four maps E_r, E_y (n,5), F, G (n,3) set the state at a bumpless change:
    x = E_r r + E_y y + F (wanted - u at that x) + G (wanted - u one tick later).
    """

    law: Law
    T_s: float
    A: Matrix
    B_r: Matrix
    B_y: Matrix
    C: Matrix
    D_r: Matrix
    D_y: Matrix
    D_u0: Matrix
    u_0: Matrix
    rows: tuple[int, ...]
    W: Matrix
    E_r: Matrix
    E_y: Matrix
    F: Matrix
    G: Matrix

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.rows)

    def closed(self) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix, Matrix]:
        """(A, B_r, B_y, C, D_r, D_y) with the omega_u loop closed; column 3 of B_y, D_y is 0."""
        gain = 1.0 / (1.0 - self.D_y[OMEGA_ROW, OMEGA_COLUMN])
        b, d = self.B_y[:, [OMEGA_COLUMN]] * gain, self.D_y[:, [OMEGA_COLUMN]] * gain
        B_y, D_y = self.B_y.copy(), self.D_y.copy()
        B_y[:, OMEGA_COLUMN], D_y[:, OMEGA_COLUMN] = 0.0, 0.0
        c, d_r, d_y = self.C[[OMEGA_ROW]], self.D_r[[OMEGA_ROW]], D_y[[OMEGA_ROW]]
        return (
            self.A + b @ c,
            self.B_r + b @ d_r,
            B_y + b @ d_y,
            self.C + d @ c,
            self.D_r + d @ d_r,
            D_y + d @ d_y,
        )


def discretise(law: Law, T_s: float, prewarp: float | None = None) -> DiscreteLaw:
    """Discretise a law by Tustin at T_s [s]; ``prewarp`` [rad/s] is matched exactly if given.

    Raises:
        LawError: T_s or prewarp out of range, an omega_u loop without solution, a law that is
            unstable at this T_s, a coefficient that is not finite.
    """
    if not (math.isfinite(T_s) and T_s > 0.0):
        raise LawError("T_s", f"{T_s} s must be > 0")
    half = T_s / 2
    if prewarp is not None:
        if not 0.0 < prewarp < math.pi / T_s:
            raise LawError("prewarp", f"{prewarp} rad/s must lie in (0, {math.pi / T_s:g})")
        half = math.tan(prewarp * T_s / 2) / prewarp
    ss = realise(law)
    eye = np.eye(ss.order)
    backward = np.linalg.inv(eye - half * ss.A)
    A = backward @ (eye + half * ss.A)
    B_r, B_y = backward @ ss.B_r * (2 * half), backward @ ss.B_y * (2 * half)
    C = ss.C @ backward
    D_r, D_y = ss.D_r + half * ss.C @ backward @ ss.B_r, ss.D_y + half * ss.C @ backward @ ss.B_y
    W, E_r, E_y, F, G = (np.zeros((ss.order, k)) for k in (NU, NY, NY, NU, NU))
    for i in range(NU):
        k = np.flatnonzero(np.asarray(ss.rows) == i)
        if len(k):
            block = np.ix_(k, k)
            W[k, i] = _slowest(A[block], C[i, k]) * min(1.0, T_s / law.limits.T_t)
            E_r[k], E_y[k], F[k, i], G[k, i] = _take_over(
                A[block], B_r[k], B_y[k], C[i, k], D_r[i], D_y[i]
            )
    discrete = DiscreteLaw(
        law, T_s, A, B_r, B_y, C, D_r, D_y, ss.D_u0, ss.u_0, ss.rows, W, E_r, E_y, F, G
    )
    _check(discrete, ss)
    return discrete


def _slowest(A: Matrix, c: Matrix) -> Matrix:
    """Direction of the slowest real mode, scaled to move the output by one; 0 if there is none.

    Correcting only this mode (an integrator, if the row has one) lets the row leave its limit at
    once and leaves the faster modes alone.
    """
    values, vectors = np.linalg.eig(A)
    real = np.flatnonzero(np.abs(values.imag) < 1e-12)
    if not len(real):
        return np.zeros(len(A))
    slowest = real[np.argmax(values.real[real])]
    v = vectors[:, slowest].real
    reach = float(c @ v)
    return v / reach if abs(reach) > 1e-12 else np.zeros(len(A))


def _take_over(
    A: Matrix, B_r: Matrix, B_y: Matrix, c: Matrix, d_r: Matrix, d_y: Matrix
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """E_r, E_y, F, G of one row: nearest to its rest state, the output and its next value right.

    The rest state is (I-A)^# B (r, y), with integrators at 0; the least-norm correction then
    makes u[k] and, with two or more states, u[k+1] what the law before it would have given.
    """
    n = len(A)
    values, vectors = np.linalg.eig(A)
    integrators = np.abs(values - 1.0) < 1e-9
    projector = np.zeros((n, n))
    if integrators.any():
        projector = np.real(vectors[:, integrators] @ np.linalg.inv(vectors)[integrators])
    drazin = np.linalg.inv(np.eye(n) - A + projector) - projector
    rest_r, rest_y = drazin @ B_r, drazin @ B_y
    if n == 1:
        correct = np.array([[1.0 / c[0], 0.0]])
    else:
        correct = np.linalg.pinv(np.vstack([c, c @ A]))
    f, g = correct[:, 0], correct[:, 1]
    # residuals of the two equations at the rest state, as maps of r and y
    E_r = rest_r - np.outer(f, c @ rest_r + d_r) - np.outer(g, c @ (A @ rest_r + B_r) + d_r)
    E_y = rest_y - np.outer(f, c @ rest_y + d_y) - np.outer(g, c @ (A @ rest_y + B_y) + d_y)
    return E_r, E_y, f, g


def _check(discrete: DiscreteLaw, ss: LawStateSpace) -> None:
    law = discrete.law
    loop = discrete.D_y[OMEGA_ROW, OMEGA_COLUMN]
    column_3 = [
        cell_name(m, (OMEGA_ROW, OMEGA_COLUMN))
        for m in ("phi", "psi")
        if not law.element(m, (OMEGA_ROW, OMEGA_COLUMN)).is_zero
    ]
    if loop >= 1.0 - 1e-9:
        raise LawError(" and ".join(column_3), f"the omega_u loop gain {loop:g} must be < 1 at T_s")
    for name in ("A", "B_r", "B_y", "C", "D_r", "D_y", "u_0"):
        if not np.isfinite(getattr(discrete, name)).all():
            raise LawError(_culprit(law), f"{name} has a coefficient that is not finite")
    for i in range(NU):
        k = np.flatnonzero(np.asarray(ss.rows) == i)
        if len(k) and np.max(np.abs(np.linalg.eigvals(discrete.A[np.ix_(k, k)]))) > 1 + _ON_CIRCLE:
            raise LawError(_culprit(law, i), f"unstable at T_s = {discrete.T_s:g} s")
    if discrete.order:
        radius = np.max(np.abs(np.linalg.eigvals(discrete.closed()[0])))
        if radius > 1 + _ON_CIRCLE:
            raise LawError(
                " and ".join(column_3), f"the omega_u loop is unstable, spectral radius {radius:g}"
            )


def _culprit(law: Law, row: int | None = None) -> str:
    """The dynamic elements of a row (or of the whole law), by the paper's names."""
    found = [
        cell_name(matrix, cell)
        for matrix, cells in (("phi", law.phi), ("psi", law.psi))
        for cell, element in cells.items()
        if element.den and row in (None, cell[0])
    ]
    return ", ".join(sorted(found)) or law.name
