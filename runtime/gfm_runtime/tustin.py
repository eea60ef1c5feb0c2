"""Tustin's discretisation of a whole law, and the checks before it reaches the kernel.

    x[k+1] = A x[k] + B_r r[k] + B_y y[k]
    u[k]   = u_0 + C x[k] + D_r r[k] + D_y y[k]

Column 3 of B_y and D_y multiplies the law's own omega_u[k] *of the same tick*: the kernel solves
the scalar loop omega_u = (...) + D_y[1,2] omega_u in closed form, so no hidden delay enters.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.errors import LawError
from gfm_runtime.law import BuiltLaw, cell_name
from gfm_runtime.realisation import LawStateSpace, realise
from gfm_runtime.signals import NU, NY

Matrix = NDArray[np.float64]

OMEGA_ROW, OMEGA_COLUMN = 1, 2
_ON_CIRCLE = 1e-9  # |z| beyond 1 + this is unstable; an integrator sits at 1 to rounding


@dataclass(frozen=True)
class DiscreteLaw(LawStateSpace):
    """A law at one sampling time T_s, s: its state space from tick to tick.

    W (n,3) is the anti-windup gain: x is moved by W (u_clamped - u_raw) before it steps.
    The four maps E_r, E_y (n,5), F, G (n,3) set the state at a bumpless change:
    x = E_r r + E_y y + F (u - u_0) + G (change of u per tick).
    """

    law: BuiltLaw
    T_s: float
    W: Matrix
    E_r: Matrix
    E_y: Matrix
    F: Matrix
    G: Matrix

    def closed(self) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix, Matrix]:
        """(A, B_r, B_y, C, D_r, D_y) with the omega_u loop closed; column 3 of B_y, D_y is 0."""
        B, D = np.hstack([self.B_y, self.B_r]), np.hstack([self.D_y, self.D_r])
        A, B, C, D = close_omega_u(self.A, B, self.C, D)
        return A, B[:, NY:], B[:, :NY], C, D[:, NY:], D[:, :NY]


def close_omega_u(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """A law's state space (x' = A x + B (y, r), u = C x + D (y, r)) with its omega_u loop closed.

    Solves omega_u = (...) + D[1,2] omega_u; columns 2 of the new B and D are 0. Shapes (..., n, n),
    (..., n, m), (..., 3, n), (..., 3, m) with m >= 5; the matrices may be those of several laws.
    """
    row, column = [OMEGA_ROW], [OMEGA_COLUMN]
    gain = 1.0 / (1.0 - D[..., row, :][..., column])
    b, d = B[..., column] * gain, D[..., column] * gain
    B, D = B.copy(), D.copy()
    B[..., column], D[..., column] = 0.0, 0.0
    c_omega, d_omega = C[..., row, :], D[..., row, :]
    return A + b @ c_omega, B + b @ d_omega, C + d @ c_omega, D + d @ d_omega


def tustin(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix, half: float
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Tustin's discretisation of dx/dt = A x + B w, z = C x + D w, any number of w and z.

    The matrices may have leading axes. ``half`` is half the sampling time in s:
    s = (z - 1)/(z + 1)/half.
    """
    eye = np.eye(A.shape[-1])
    backward = np.linalg.inv(eye - half * A)
    return (
        backward @ (eye + half * A),
        backward @ B * (2 * half),
        C @ backward,
        D + half * C @ backward @ B,
    )


def discretise(law: BuiltLaw, T_s: float) -> DiscreteLaw:
    """Discretise a law by Tustin at T_s [s]. Raises LawError: T_s out of range, an omega_u loop
    without solution or unstable, and as ``realise``."""
    if not (math.isfinite(T_s) and T_s > 0.0):
        raise LawError("T_s", f"{T_s} s must be > 0")
    ss = realise(law)
    B, D = np.hstack([ss.B_r, ss.B_y]), np.hstack([ss.D_r, ss.D_y])
    A, B, C, D = tustin(ss.A, B, ss.C, D, T_s / 2)
    B_r, B_y, D_r, D_y = B[:, :NY], B[:, NY:], D[:, :NY], D[:, NY:]
    W, E_r, E_y, F, G = (np.zeros((ss.order, k)) for k in (NU, NY, NY, NU, NU))
    for i in range(NU):
        k = np.flatnonzero(np.asarray(ss.rows) == i)
        if len(k):
            block = np.ix_(k, k)
            W[k, i] = _slowest(A[block], C[i, k]) * min(1.0, T_s / law.limits.T_t)
            if i == OMEGA_ROW:  # the omega_u loop passes on 1/(1 - D_y) of what x moves
                W[k, i] *= 1.0 - D_y[i, OMEGA_COLUMN]
            E_r[k], E_y[k], F[k, i], G[k, i] = _take_over(
                A[block], B_r[k], B_y[k], C[i, k], D_r[i], D_y[i]
            )
    discrete = DiscreteLaw(
        A, B_r, B_y, C, D_r, D_y, ss.D_u0, ss.u_0, ss.rows, law, T_s, W, E_r, E_y, F, G
    )
    _check(discrete)
    return discrete


def _slowest(A: Matrix, c: Matrix) -> Matrix:
    """Direction of the slowest mode that does not swing, scaled to move the output by one, or 0.

    Correcting only this mode (an integrator, if the row has one) lets the row leave its limit at
    once and leaves the faster modes alone.
    """
    values, vectors = np.linalg.eig(A)
    # rounding splits a double real root into a pair with a small imaginary part
    real = np.flatnonzero(np.abs(values.imag) <= 1e-3 * np.abs(1.0 - values))
    if not len(real):
        return np.zeros(len(A))
    v = vectors[:, real[np.argmax(values.real[real])]].real
    return v / (c @ v)


def _take_over(
    A: Matrix, B_r: Matrix, B_y: Matrix, c: Matrix, d_r: Matrix, d_y: Matrix
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """E_r, E_y, F, G of one row: nearest to its rest state, the output and its change right.

    The rest state is (I-A)^# B (r, y), with an integrator at 0; the least-norm correction then
    makes u[k] and, with two or more states, u[k+1] - u[k] what the law before it would have given.
    """
    n = len(A)
    move = A - np.eye(n)
    projector = np.zeros((n, n))
    if np.min(np.abs(np.linalg.eigvals(A) - 1.0)) < 1e-9:  # an integrator; a row has one at most
        left, _, right = np.linalg.svd(move)
        projector = np.outer(right[-1], left[:, -1]) / (left[:, -1] @ right[-1])
    drazin = np.linalg.inv(projector - move) - projector
    rest_r, rest_y = drazin @ B_r, drazin @ B_y
    slope = c @ move
    unit = float(np.linalg.norm(slope)) or 1.0  # makes both equations of one size
    equations = np.vstack([c, slope / unit]) if n > 1 else c[None, :]
    correct = np.zeros((n, 2))
    correct[:, : len(equations)] = np.linalg.pinv(equations)
    f, g = correct[:, 0], correct[:, 1] / unit
    # residuals of the two equations at the rest state, as maps of r and y
    E_r = rest_r - np.outer(f, c @ rest_r + d_r) - np.outer(g, slope @ rest_r + c @ B_r)
    E_y = rest_y - np.outer(f, c @ rest_y + d_y) - np.outer(g, slope @ rest_y + c @ B_y)
    return E_r, E_y, f, g


def _check(discrete: DiscreteLaw) -> None:
    law = discrete.law
    loop = discrete.D_y[OMEGA_ROW, OMEGA_COLUMN]
    column_3 = " and ".join(
        cell_name(m, (OMEGA_ROW, OMEGA_COLUMN))
        for m in ("phi", "psi")
        if not law.element(m, (OMEGA_ROW, OMEGA_COLUMN)).is_zero
    )
    if loop >= 1.0 - 1e-9:
        raise LawError(column_3, f"the omega_u loop gain {loop:g} must be < 1 at T_s")
    poles = np.linalg.eigvals(discrete.closed()[0])
    radius = np.max(np.abs(poles), initial=0.0)
    if radius > 1 + _ON_CIRCLE:
        raise LawError(
            column_3 or law.dynamic(),
            f"unstable at T_s = {discrete.T_s:g} s, spectral radius {radius:g}",
        )
