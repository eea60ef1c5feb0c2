"""Continuous state space of a whole law, with as few states as its rows need.

Each row of Phi(s) is written over the least common multiple of its denominators and realised in
observer form, so elements of one row that share a factor share its states (MIMO-GFM needs three:
the DC integrator, the inertia factor, the q-V integrator). States are scaled by powers of two so
that a time constant of microseconds beside one of seconds stays well conditioned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.elements import INTEGRATOR, Factor, Polynomial, over, poly_add, poly_mul, union
from gfm_runtime.errors import LawError
from gfm_runtime.law import Law, cell_name
from gfm_runtime.signals import NU, NY, REF_NAMES

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LawStateSpace:
    """dx/dt = A x + B_r r + B_y y,  u = u_0 + C x + D_r r + D_y y.

    r and y are the *mapped* references and measurements (five each), in p.u.; u_0 holds the
    constant part of the set-points (the part that follows a reference is in D_u0, which acts on
    the unmapped references).

    Shapes: A (n,n), B_r and B_y (n,5), C (3,n), D_r and D_y (3,5), D_u0 (3,5), u_0 (3,),
    rows: n integers, the row of u that each state belongs to.
    """

    A: Matrix
    B_r: Matrix
    B_y: Matrix
    C: Matrix
    D_r: Matrix
    D_y: Matrix
    D_u0: Matrix
    u_0: Matrix
    rows: tuple[int, ...]

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.rows)

    def __call__(self, s: complex) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Transfer matrices (r to u, y to u) at s, without u_0; both (3,5)."""
        A, B_r, B_y, C = (m.astype(np.complex128) for m in (self.A, self.B_r, self.B_y, self.C))
        CX = C @ np.linalg.inv(s * np.eye(self.order) - A)
        return CX @ B_r + self.D_r, CX @ B_y + self.D_y


def realise(law: Law) -> LawStateSpace:
    """State space of a law.

    Raises:
        LawError: two integrators in series through omega_u, a coefficient that is not finite.
    """
    _check_series(law)
    blocks = [_row(law, i) for i in range(NU)]
    n = sum(len(a) for a, *_ in blocks)
    A, C = np.zeros((n, n)), np.zeros((NU, n))
    B_r, B_y = np.zeros((n, NY)), np.zeros((n, NY))
    D_r, D_y = np.zeros((NU, NY)), np.zeros((NU, NY))
    rows: list[int] = []
    for i, (a, b_r, b_y, d_r, d_y) in enumerate(blocks):
        k = slice(len(rows), len(rows) + len(a))
        A[k, k], B_r[k], B_y[k], D_r[i], D_y[i] = a, b_r, b_y, d_r, d_y
        if len(a):
            C[i, k.start] = 1.0
        rows += [i] * len(a)
    u_0, D_u0 = np.zeros(NU), np.zeros((NU, NY))
    for i, value in enumerate(law.u_0):
        if isinstance(value, str):
            D_u0[i, REF_NAMES.index(value)] = 1.0
        else:
            u_0[i] = value
    return LawStateSpace(A, B_r, B_y, C, D_r, D_y, D_u0, u_0, tuple(rows))


def _check_series(law: Law) -> None:
    """Refuse an integrator of omega_u before one behind it; one in column 3 closes its own loop."""

    def integrates(matrix: str, i: int, j: int) -> bool:
        return INTEGRATOR in law.element(matrix, (i, j)).den

    own = any(integrates(m, 1, 2) for m in ("phi", "psi"))
    if own or not any(integrates(m, 1, j) for m in ("phi", "psi") for j in range(NY)):
        return
    for matrix in ("phi", "psi"):
        for i in (0, 2):
            if integrates(matrix, i, 2):
                why = "integrates omega_u, itself an integral: a double integrator 1/s^2"
                raise LawError(cell_name(matrix, (i, 2)), why)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what comes of it is refused below
def _row(law: Law, i: int) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Observer form of row i: A, B_r, B_y, D_r, D_y; its C is (1, 0, ..., 0)."""
    phi = [law.element("phi", (i, j)) for j in range(NY)]
    psi = [law.element("psi", (i, j)) for j in range(NY)]
    den = union([e.den for e in (*phi, *psi)])
    d, m = _expand(den)
    A = np.zeros((m, m))
    for k in range(m):
        A[k, 0] = -d[m - 1 - k]
        if k + 1 < m:
            A[k, k + 1] = 1.0
    B_r, B_y = np.zeros((m, NY)), np.zeros((m, NY))
    D_r, D_y = np.zeros(NY), np.zeros(NY)
    for j in range(NY):
        on_error, feedback = over(phi[j], den), over(psi[j], den)
        on_y = poly_add([-c for c in on_error], [-c for c in feedback])
        D_r[j], B_r[:, j] = _numerator(on_error, den, d)
        D_y[j], B_y[:, j] = _numerator(on_y, den, d)
    if not all(np.isfinite(part).all() for part in (A, B_r, B_y, D_r, D_y)):
        raise LawError(law.dynamic(i), "together they give a coefficient that is not finite")
    T = 2.0 ** np.round(np.log2(_scale(d)) * np.arange(m))  # exact powers of two; T[0] = 1
    return A * T[None, :] / T[:, None], B_r / T[:, None], B_y / T[:, None], D_r, D_y


def _expand(den: tuple[Factor, ...]) -> tuple[Polynomial, int]:
    """Monic polynomial of the factors (ascending, without the leading 1) and its degree."""
    d: Polynomial = (1.0,)
    for factor in den:
        d = poly_mul(d, [c / factor[-1] for c in factor])
    return d[:-1], len(d) - 1


def _numerator(num: Polynomial, den: tuple[Factor, ...], d: Polynomial) -> tuple[float, Matrix]:
    """Feed-through and observer-form input column of num(s)/den(s)."""
    m = len(d)
    lead = math.prod(f[-1] for f in den)
    b = np.zeros(m + 1)
    b[: len(num)] = np.asarray(num) / lead
    through = float(b[m])
    return through, (b[:m] - through * np.asarray(d))[::-1]


def _scale(d: Polynomial) -> float:
    """A typical frequency of the polynomial: geometric mean of its non-zero roots."""
    nonzero = [(k, c) for k, c in enumerate(d) if c != 0.0]
    if not nonzero or len(d) < 2:
        return 1.0
    k, c = nonzero[0]
    return float(abs(c) ** (1.0 / (len(d) - k)))
