"""Continuous state space of a whole law, with as few states as its rows need.

Each row of Phi(s) is written over the least common multiple of its denominators and realised in
observer form, so elements of one row that share a factor share its states (MIMO-GFM needs three:
the DC integrator, the inertia factor, the q-V integrator). States are scaled by powers of two so
that a law with time constants of microseconds and of seconds stays well conditioned.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.elements import INTEGRATOR, Element, Polynomial, over, poly_add, poly_mul, union
from gfm_runtime.errors import LawError
from gfm_runtime.law import BuiltLaw, cell_name
from gfm_runtime.signals import NU, NY, REF_NAMES

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class LawStateSpace:
    """dx/dt (discrete: the next x) = A x + B_r r + B_y y,  u = u_0 + C x + D_r r + D_y y.

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
        """Transfer matrices (r to u, y to u) at s (discrete: at z), without u_0; both (3,5)."""
        A, B_r, B_y, C = (m.astype(np.complex128) for m in (self.A, self.B_r, self.B_y, self.C))
        CX = C @ np.linalg.inv(s * np.eye(self.order) - A)
        return CX @ B_r + self.D_r, CX @ B_y + self.D_y


class Row(NamedTuple):
    """A row of a law in observer form: A (m,m), B_r and B_y (m,5), D_r and D_y (5,)."""

    A: Matrix
    B_r: Matrix
    B_y: Matrix
    D_r: Matrix
    D_y: Matrix


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what comes of it is refused
def realise(law: BuiltLaw) -> LawStateSpace:
    """State space of a law. Raises LawError: two integrators in series through omega_u, a
    coefficient that is not finite."""
    _check_series(law)
    rows = []
    for i in range(NU):
        phi, psi = ([law.element(matrix, (i, j)) for j in range(NY)] for matrix in ("phi", "psi"))
        rows.append(row_of(phi, psi))
        if not all(np.isfinite(part).all() for part in rows[-1]):
            raise LawError(law.dynamic(i), "together they give a coefficient that is not finite")
    return assemble(rows, law.u_0)


def assemble(rows: Sequence[Row], u_0: Sequence[float | str]) -> LawStateSpace:
    """The state space of a law, or of several on a leading axis, from its three rows.

    ``rows`` are as ``row_of`` gives them, ``u_0`` as a ``BuiltLaw`` has it.
    """
    many = np.broadcast_shapes(*(row.A.shape[:-2] for row in rows))
    of_row = [i for i, row in enumerate(rows) for _ in range(row.A.shape[-1])]
    n = len(of_row)
    A, C = np.zeros((*many, n, n)), np.zeros((*many, NU, n))
    B_r, B_y = np.zeros((*many, n, NY)), np.zeros((*many, n, NY))
    D_r, D_y = np.zeros((*many, NU, NY)), np.zeros((*many, NU, NY))
    at = 0
    for i, row in enumerate(rows):
        m = row.A.shape[-1]
        k = slice(at, at + m)
        A[..., k, k], B_r[..., k, :], B_y[..., k, :] = row.A, row.B_r, row.B_y
        D_r[..., i, :], D_y[..., i, :] = row.D_r, row.D_y
        C[..., i, at : at + min(1, m)] = 1.0
        at += m
    constant, D_u0 = np.zeros(NU), np.zeros((NU, NY))
    for i, value in enumerate(u_0):
        if isinstance(value, str):
            D_u0[i, REF_NAMES.index(value)] = 1.0
        else:
            constant[i] = value
    return LawStateSpace(A, B_r, B_y, C, D_r, D_y, D_u0, constant, tuple(of_row))


def _check_series(law: BuiltLaw) -> None:
    """Refuse two integrators in series through omega_u; one in column 3 closes its own loop."""

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


def row_of(phi: Sequence[Element], psi: Sequence[Element], smooth: bool = False) -> Row:
    """Observer form of a row by its elements, five each; those of N laws give N rows.

    The states are scaled by powers of two, which is exact; or, if ``smooth``, so that the matrices
    are smooth in the elements' numbers.
    """
    den = union([e.den for e in (*phi, *psi)])
    d: Polynomial = (1.0,)
    for factor in den:
        d = poly_mul(d, [c / factor[-1] for c in factor])
    lead = math.prod(f[-1] for f in den)
    errors, feedbacks = ([over(e, den) for e in elements] for elements in (phi, psi))
    measured = [
        poly_add([-c for c in error], [-c for c in feedback])
        for error, feedback in zip(errors, feedbacks, strict=True)
    ]
    shape = np.broadcast_shapes(*(np.shape(c) for p in (d, *errors, *measured) for c in p))
    monic = np.stack([np.broadcast_to(c, shape) for c in d], axis=-1)
    on_r, on_y = np.zeros((2, *shape, NY, len(d)))
    for numerators, on in ((errors, on_r), (measured, on_y)):
        for j, numerator in enumerate(numerators):
            for k, c in enumerate(numerator):
                on[..., j, k] = c / lead
    T: Matrix = powers(monic)
    T = T if smooth else np.exp2(np.round(np.log2(T)))
    m = monic.shape[-1] - 1
    A = np.zeros((*monic.shape[:-1], m, m))
    if m:
        A[..., 0] = -monic[..., m - 1 :: -1]
        A[..., : m - 1, 1:] = np.eye(m - 1)
    D_r, D_y = on_r[..., m], on_y[..., m]
    B_r, B_y = (
        np.swapaxes(b[..., :m] - b[..., m:] * monic[..., None, :m], -1, -2)[..., ::-1, :]
        for b in (on_r, on_y)
    )
    across, down = T[..., None, :], T[..., None]
    return Row(A * across / down, B_r / down, B_y / down, D_r, D_y)


def powers(d: Matrix) -> Matrix:
    """Powers 0 to m-1 of a typical frequency of monic polynomials (..., m+1), shape (..., m).

    The frequency is the geometric mean of the non-zero roots. All polynomials are taken to have as
    many roots at 0 as the first.
    """
    m = d.shape[-1] - 1
    zeros = int(np.argmax(d.reshape(-1, m + 1)[0] != 0.0))
    typical = np.abs(d[..., zeros]) ** (1.0 / max(m - zeros, 1))
    return np.asarray(typical)[..., None] ** np.arange(m)
