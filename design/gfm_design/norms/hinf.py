"""The H-infinity norm with a guarantee: Bruinsma and Steinbuch's level-set method.

A level gamma is crossed by singular values of G(j omega) exactly at the imaginary eigenvalues of a
Hamiltonian matrix. The level starts from a gain that is reached and rises to
the largest gain between its crossings until it has none: then the gain exceeds it at no frequency.
N. A. Bruinsma and M. Steinbuch, "A fast algorithm to compute the H-infinity norm of a transfer
function matrix", Systems & Control Letters 14 (1990).

An unstable system has no H-infinity norm, although its L-infinity norm may be finite. It is
refused, with the unstable eigenvalue.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

_ROUNDS = 60
# an eigenvalue this close to the axis, relative to its size, may be a crossing: if a level touches
# a peak, the error of the eigenvalues is the root of the rounding; one too many costs little
_CROSSES = 1e-2
_ZOOMS = 12


class Unstable(ArithmeticError):
    """The system is not stable; ``eigenvalue`` is the one furthest out (1/s, or z)."""

    def __init__(self, eigenvalue: complex, discrete: bool) -> None:
        self.eigenvalue = eigenvalue
        where = f"|z| = {abs(eigenvalue):.6g}" if discrete else f"{eigenvalue.real:+.6g} 1/s"
        super().__init__(f"unstable: an eigenvalue {eigenvalue:.6g} at {where}")


class Norm(NamedTuple):
    """gain: the H-infinity norm; omega: where it is reached, rad/s (inf: only in the limit)."""

    gain: float
    omega: float


def hinf_norm(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix, T_s: float | None = None, tol: float = 1e-9
) -> Norm:
    """H-infinity norm of C (sI - A)^-1 B + D, or with z if a sampling time T_s [s] is given.

    Args:
        A, B, C, D: state space, shapes (n,n), (n,m), (p,n), (p,m).
        T_s: sampling time of a discrete system; None for a continuous one.
        tol: relative accuracy of the gain.

    Raises:
        Unstable: an eigenvalue of A is not in the open left half plane (unit disk).
    """
    poles = np.linalg.eigvals(A) if len(A) else np.zeros(0)
    if T_s is not None:
        if len(poles) and np.abs(poles).max() >= 1.0:
            raise Unstable(complex(poles[np.argmax(np.abs(poles))]), True)
        # s = (z-1)/(z+1): the norm stays, omega becomes tan(omega T_s / 2)
        eye, root = np.eye(len(A)), np.sqrt(2)
        inverse = np.linalg.inv(A + eye)
        D = D - C @ inverse @ B
        gain, omega = hinf_norm(
            inverse @ (A - eye), root * inverse @ B, root * C @ inverse, D, tol=tol
        )
        return Norm(gain, 2 / T_s * float(np.arctan(omega)))
    if len(poles) and poles.real.max() >= 0.0:
        raise Unstable(complex(poles[np.argmax(poles.real)]), False)
    A, B, C = balance(A, B, C)
    # every pole is a candidate for the peak; resonances sit near |pole|
    best = Norm(_sigma(D), np.inf)
    for omega in {0.0, *np.abs(poles), *np.abs(poles.imag)}:
        best = max(best, _gain(A, B, C, D, float(omega)))
    if best.gain == 0.0:
        return best
    best = _climb(A, B, C, D, best)
    for _ in range(_ROUNDS):
        crossings = _crossings(A, B, C, D, best.gain * (1 + 2 * tol))
        middles = np.sqrt(crossings[1:] * crossings[:-1]) if len(crossings) > 1 else crossings
        better = max((_gain(A, B, C, D, float(w)) for w in [*middles, *crossings]), default=best)
        if better.gain <= best.gain * (1 + tol):
            break
        best = _climb(A, B, C, D, better)
    return best


def _crossings(A: Matrix, B: Matrix, C: Matrix, D: Matrix, level: float) -> Matrix:
    """Frequencies [rad/s] at which a singular value may equal the level, ascending."""
    R = level * level * np.eye(D.shape[1]) - D.T @ D
    S = level * level * np.eye(D.shape[0]) - D @ D.T
    F = A + B @ np.linalg.solve(R, D.T @ C)
    # scaled so that both off-diagonal blocks have the size of a gain, not of its square
    H = np.block(
        [[F, level * B @ np.linalg.solve(R, B.T)], [-level * C.T @ np.linalg.solve(S, C), -F.T]]
    )
    values = np.linalg.eigvals(H)
    near = np.abs(values.real) <= _CROSSES * np.maximum(np.abs(values), 1e-12)
    return np.sort(np.unique(np.abs(values.imag[near])))


def _climb(A: Matrix, B: Matrix, C: Matrix, D: Matrix, start: Norm) -> Norm:
    """The maximum of the peak around ``start``, by repeated refinement around the best point."""
    best, reach = start, 0.05
    if not np.isfinite(start.omega) or start.omega == 0.0:
        return start
    eye = np.eye(len(A))
    for _ in range(_ZOOMS):
        omega = best.omega * (1.0 + reach * np.linspace(-1.0, 1.0, 9))
        inner = np.linalg.solve(1j * omega[:, None, None] * eye - A, B[None].astype(complex))
        sizes = np.linalg.svd(C @ inner + D, compute_uv=False)[:, 0]
        k = int(np.argmax(sizes))
        best = max(best, Norm(float(sizes[k]), float(omega[k])))
        reach /= 4.0
    return best


def _gain(A: Matrix, B: Matrix, C: Matrix, D: Matrix, omega: float) -> Norm:
    response = C @ np.linalg.solve(1j * omega * np.eye(len(A)) - A, B.astype(complex)) + D
    return Norm(_sigma(response), omega)


def _sigma(M: NDArray[np.complex128] | Matrix) -> float:
    if M.shape == (1, 1):
        return float(abs(M[0, 0]))
    return float(np.linalg.svd(M, compute_uv=False)[0]) if M.size else 0.0


def balance(A: Matrix, B: Matrix, C: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """Scale the states by powers of two until rows and columns are of one size.

    Poles from 1e-4 to 1e5 rad/s stand side by side in a weighted loop.
    """
    A, B, C = A.copy(), B.copy(), C.copy()
    own = A.diagonal().copy()  # no scaling changes it
    np.fill_diagonal(A, 0.0)
    for _ in range(20):
        steady = True
        for i in range(len(A)):
            row = np.sqrt(A[i] @ A[i]) + np.sqrt(B[i] @ B[i])
            column = np.sqrt(A[:, i] @ A[:, i]) + np.sqrt(C[:, i] @ C[:, i])
            if row == 0.0 or column == 0.0:
                continue
            factor = 2.0 ** round(0.5 * np.log2(row / column))
            if factor != 1.0:
                steady = False
                A[i] /= factor
                B[i] /= factor
                A[:, i] *= factor
                C[:, i] *= factor
        if steady:
            break
    np.fill_diagonal(A, own)
    return A, B, C
