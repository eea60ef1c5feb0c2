"""Whether every sequence of hits and misses is stable that respects a constraint.

Two constraints, as of weakly hard real time: at most n misses in a row, and at most m misses in any
K ticks. A sequence of the first is a concatenation of pieces "i misses, then a hit", i = 0 ... n;
one of the second is one of pieces of K ticks with at most m misses. The loop is stable under all of
them if the joint spectral radius of the pieces' matrices is below 1 (M. Maggio, A. Hamann,
E. Mayer-John and D. Ziegenbein, Control-System Stability Under Consecutive Deadline Misses
Constraints, ECRTS 2020). From above it is bounded by an ellipsoid: with P > 0 and

    A^T P A <= exp(2 sigma l T_s) P    for every piece A of l ticks

all sequences decay by sigma at least. The best P solves a generalised eigenvalue problem, here by
the method of centres (S. Boyd and L. El Ghaoui, Linear Algebra and its Applications 188, 1993).
Words bound it from below. Pieces of K ticks may have 2 m misses in the K ticks around their
joint: what they prove for at most m of K is true, but not all that is true.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from gfm_design.misses.ticks import Matrix, Ticks
from gfm_design.misses.words import Words

MOST_IN_A_ROW = 100  # as far as a proof is sought
LONGEST_WINDOW = 12  # ticks: 4096 pieces
_CENTRING = 30
_FASTER = 10.0
_PRECISION = 1e-7
_ROUND = 1e8
_HALVINGS, _ENOUGH = 8, 0.05  # of sigma, relative
_STRICT = 1e-3
_NEVER = 1e-12  # rate of pieces that are 0


@dataclass(frozen=True)
class Bounds:
    """Of the rate of the fastest growth among all sequences, 1/s: it lies between ``lower``, that
    of a word, and ``upper``, that of an ellipsoid."""

    lower: float
    upper: float

    @property
    def stable(self) -> bool | None:
        """Every sequence is stable; None if the bounds leave it open."""
        return True if self.upper < 0.0 else False if self.lower >= 0.0 else None


@dataclass(frozen=True)
class ProvedSequences:
    """What the bounds say of a constraint "at most n"."""

    most: int  # the largest n for which every sequence is stable
    bounds: Bounds  # those for it
    # the least n for which a word is unstable; None if there is none among those tried
    refuted: int | None
    tried: int  # the largest n that was tried


@dataclass(frozen=True)
class Pieces:
    """The matrices of which every sequence of a constraint is a concatenation."""

    matrices: Matrix  # shape (E, N, N)
    lengths: NDArray[np.int64]  # ticks of each, shape (E,)
    low: float  # the rate of a word of them, 1/s
    ticks: Ticks  # whose they are

    def proved(self) -> bool:
        """Whether an ellipsoid proves all stable."""
        return self.low < 0.0 and self._ellipsoid(-_STRICT * abs(self.low)) is not None

    def bounds(self) -> Bounds:
        """The rates between which the fastest growth lies."""
        low, high = self.low, _rate(np.eye(len(self.ticks.hit)), *self._turned) / self.ticks.T_s
        tried = -_STRICT * abs(low) if low < 0.0 <= high else 0.5 * (low + high)
        for _ in range(_HALVINGS):
            proves = self._ellipsoid(tried)
            if proves is None:
                low = tried
            else:
                high = min(high, proves)
            if high - low <= _ENOUGH * abs(self.low):
                break
            tried = 0.5 * (low + high) if high < 0.0 else low + 0.1 * (high - low)
        return Bounds(self.low, high)

    def _ellipsoid(self, sigma: float) -> float | None:
        """The rate that an ellipsoid proves which was sought for ``sigma``, 1/s; None: none was
        found."""
        A, lengths = self._turned
        P = _feasible(A, lengths, sigma * self.ticks.T_s)
        return None if P is None else _rate(P, A, lengths) / self.ticks.T_s

    @cached_property
    def _turned(self) -> tuple[Matrix, NDArray[np.int64]]:
        """The matrices in coordinates in which no hit grows, and their lengths."""
        L = _coordinates(self.ticks.hit)
        return L.T @ self.matrices @ np.linalg.inv(L.T), self.lengths


def in_a_row(words: Words, n: int) -> Pieces:
    """Those of at most n misses in a row; the loop must be stable without any."""
    hit = words.ticks.hit
    pieces = np.array([hit @ words.run(i) for i in range(n + 1)])
    return Pieces(pieces, np.arange(1, n + 2), words.slowest(n).sigma, words.ticks)


def proved_in_a_row(
    words: Words, refuted: int | None, most: int = MOST_IN_A_ROW
) -> ProvedSequences:
    """For how many misses in a row every sequence is stable, up to ``most``; a word of ``refuted``
    is unstable."""
    end = min(most, most if refuted is None else refuted - 1)
    n = _largest(0, end, lambda n: in_a_row(words, n).proved())
    return ProvedSequences(n, in_a_row(words, n).bounds(), refuted, end)


def in_a_window(ticks: Ticks, m: int, K: int) -> Pieces:
    """Those of at most m misses in any K ticks, K <= ``LONGEST_WINDOW``."""
    pieces = np.array(list(_windows(ticks, m, K)))
    size = float(np.abs(np.linalg.eigvals(pieces)).max())
    low = float(np.log(max(size, _NEVER)) / (K * ticks.T_s))
    return Pieces(pieces, np.full(len(pieces), K), low, ticks)


def proved_in_a_window(words: Words, K: int, known: int) -> ProvedSequences:
    """For how many misses in any K ticks, fewer than K, every sequence is stable; ``known`` misses
    in a row are proved, and so as many in K ticks."""
    ticks, least = words.ticks, min(known, K - 1)
    lows = ((m, in_a_window(ticks, m, K).low) for m in range(least + 1, K))
    refuted = next((m for m, low in lows if low >= 0.0), None)
    end = K - 1 if refuted is None else refuted - 1
    m = _largest(least, end, lambda m: in_a_window(ticks, m, K).proved())
    pieces = in_a_row(words, m) if m <= least else in_a_window(ticks, m, K)
    return ProvedSequences(m, pieces.bounds(), refuted, end)


def _largest(low: int, end: int, proved: Callable[[int], bool]) -> int:
    """The largest number of low ... end that is proved; ``low`` is. What is proved of a number is
    true of those below."""
    step = 1
    while low < end and proved(tried := min(low + step, end)):  # most are few: begin there
        low, step = tried, 2 * step
    high = min(low + step, end + 1) if low < end else end + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if proved(middle) else (low, middle)
    return low


def _windows(ticks: Ticks, most: int, K: int) -> Iterator[Matrix]:
    """The products of K ticks with up to ``most`` misses."""
    for m in range(most + 1):
        for where in combinations(range(K), m):
            out, row = np.eye(len(ticks.hit)), 0
            for k in range(K):
                row, A = (row + 1, ticks.miss(row)) if k in where else (0, ticks.hit)
                out = A @ out
            yield out


def _rate(P: Matrix, A: Matrix, lengths: NDArray[np.int64]) -> float:
    """log of the growth a tick that P proves."""
    root = np.linalg.cholesky(P).T
    size = np.linalg.norm(root @ A @ np.linalg.inv(root), 2, axis=(1, 2))
    return float(np.max(np.log(np.maximum(size, _NEVER)) / lengths))


def _feasible(A: Matrix, lengths: NDArray[np.int64], log_g: float) -> Matrix | None:
    """P with A^T P A < exp(2 l log_g) P for every piece; None if there is none, to rounding.

    It minimises s such that c (exp(2 l log_g) P - A^T P A) + s I > 0 and I < P < ``_ROUND`` I, by a
    barrier; c evens out the sizes.
    """
    E, N, _ = A.shape
    g = np.exp(2.0 * lengths * log_g)
    c = 1.0 / np.maximum(g, np.linalg.norm(A, 2, axis=(1, 2)) ** 2)
    g, A = (c * g)[:, None, None], np.sqrt(c)[:, None, None] * A
    eye, half = np.eye(N), np.triu_indices(N)
    both = np.where(half[0] == half[1], 1.0, 2.0)
    n, weights = len(both), 0.5 * np.outer(both, both)
    # a form in two symmetric matrices, of (ik, jl), as one in their n different elements
    (i, j), (k, m) = (x[:, None] for x in half), half
    ik_jl, il_jk = ((i * N + k) * N + j) * N + m, ((i * N + m) * N + j) * N + k
    signs = np.concatenate([np.ones((2 * E + 2, 1)), -g[:, 0], -g[:, 0]])
    weight, barriers = 1.0, N * (E + 2)

    def slack(P: Matrix, s: float) -> Matrix:
        decay = g * P - A.transpose(0, 2, 1) @ P @ A + s * eye
        return np.concatenate([decay, [P - eye, _ROUND * eye - P]])

    P = 2.0 * eye
    s = 1.0 - 1.1 * min(0.0, np.linalg.eigvalsh(slack(P, 0.0)).min())
    while barriers / weight > _PRECISION:
        for _ in range(_CENTRING):
            S = np.linalg.inv(slack(P, s))
            S_e, own, other = S[:-2], S[-2], S[-1]
            V = A @ S_e
            W = V @ A.transpose(0, 2, 1)
            SS = S_e @ S_e
            slope = other - own - (g * S_e - W).sum(0)
            by_s = weight - float(np.trace(S_e, axis1=1, axis2=2).sum())
            cross = (g * SS - A @ SS @ A.transpose(0, 2, 1)).sum(0)
            each = np.concatenate([g * S_e, W, [own, other], V, V.transpose(0, 2, 1)])
            flat = each.reshape(len(each), -1)
            curve = flat.T @ (signs * flat)
            H, b = np.empty((n + 1, n + 1)), np.empty(n + 1)
            H[:n, :n] = weights * (curve.take(ik_jl) + curve.take(il_jk))
            H[:n, n] = H[n, :n] = cross[half] * both
            H[n, n] = float((SS.trace(axis1=1, axis2=2)).sum())
            b[:n], b[n] = slope[half] * both, by_s
            x = np.linalg.solve(H, -b)
            decrement = float(np.sqrt(max(float(-b @ x), 0.0)))
            dP = np.zeros((N, N))
            dP[half] = x[:n]
            dP += dP.T - np.diag(np.diag(dP))
            step = 1.0
            while step > 1e-6 and not _positive(slack(P + step * dP, s + step * x[n])):
                step *= 0.6
            if step <= 1e-6:
                return None
            P, s = P + step * dP, s + step * x[n]
            if s < 0.0:
                return P
            if decrement < 0.3:
                break
        if s - barriers / weight > 0.0 and decrement < 0.3:
            return None
        weight *= _FASTER
    return None


def _positive(many: Matrix) -> bool:
    try:
        np.linalg.cholesky(many)
    except np.linalg.LinAlgError:
        return False
    return True


def _coordinates(hit: Matrix) -> Matrix:
    """The root L of a Lyapunov function L L^T of the stable loop without a miss: in coordinates
    L^T x no hit grows."""
    size = float(np.abs(np.linalg.eigvals(hit)).max())
    scaled = hit / np.sqrt(size)
    P = solve_discrete_lyapunov(scaled.T, np.eye(len(hit)))
    return np.asarray(np.linalg.cholesky(0.5 * (P + P.T)))
