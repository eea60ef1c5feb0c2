"""Decentralised certificates: converters that are stable in every network of a class.

A network of R-L lines behind an ideal grid, with converters at some of its nodes, has the
admittance sum_l b_l A_l ⊗ 1/z_l(s): b_l = 1/|z_l| at nominal frequency, A_l the graph's matrix of
line l. All is multiplied by a reference line z(s) with |z| = 1. Then line l has w_l = z/z_l, near
1, and converter i of rating S_i has S_i M_i with M_i = z Y_i. At a frequency the loop is singular
only if there are x with

    sum_l b_l x^H (A_l ⊗ w_l) x + sum_i S_i x_i^H M_i x_i = 0.

z, w_l and any K = diag(k_+, k_-) in sequence coordinates commute with the turn of a converter's
frame, so the angles in the network do not matter. With lambda S <= B <= Lambda S for B = sum_l b_l
A_l, neither does its size: it is enough that one K makes

    diag(m_+, m_-) + He(K M_i) > 0 for each i,
    m = the least of lambda Re(k w_l) and Lambda Re(k w_l) over the lines

(He: the Hermitian part). K = 1/z is passivity, K = 1 the small gain by the numerical radius. A K is
searched by linear programs, whose cuts are the directions x that violate it most. This is "gain
and phase" (Huang et al., arXiv 2309.08037) with lines of different R/X and a phase for each
sequence. Loads, resistors or R and L in series with the admittance y, need He(K z y) >= 0.

Each network of the class turns into each other one without leaving the class, so no pole can cross
the imaginary axis on the way: if one of them is stable, all are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

Vector = NDArray[np.float64]
Response = NDArray[np.complex128]

#: from the sequence coordinates to d, q
_SEQUENCES = np.array([[1.0, 1.0], [-1j, 1j]]) / np.sqrt(2.0)
_LINES = 9  # of different X/R, evenly apart by ratio
_CUTS = 60  # linear programs for a K, at most
_CLOSE = 0.05  # relative, between the value of a K and the bound of the last program
_FINEST = 1e-3  # relative width of an interval that is not halved any more


@dataclass(frozen=True)
class GridClass:
    """Networks of R-L lines with an ideal grid.

    Attributes:
        weakest, stiffest: least and largest eigenvalue of S^-1 B, p.u.: the generalised
            short-circuit ratios, of one converter its short-circuit ratio at its filter capacitor.
            The stiffest may be infinite; no line may then have a negative part in He(K w).
        x_over_r: range of the lines' X/R at nominal frequency.
        loads: whether resistors and series R-L loads may be at any node.
        f_n: nominal frequency, Hz.
    """

    weakest: float
    stiffest: float
    x_over_r: tuple[float, float]
    loads: bool = False
    f_n: float = 50.0

    def __post_init__(self) -> None:
        low, high = self.x_over_r
        if not 0.0 < self.weakest <= self.stiffest:
            raise ValueError(f"scr = {self.weakest:g}:{self.stiffest:g}: must be 0 < low <= high")
        if not 0.0 < low <= high < np.inf:
            raise ValueError(f"x_over_r = {low:g}:{high:g}: must be 0 < low <= high, finite")

    def line(self, hz: Vector, x_over_r: float) -> Response:
        """A line of |z| = 1 in sequence coordinates, shape (K, 2), p.u.; hz in the dq frame."""
        x = x_over_r / np.hypot(1.0, x_over_r)
        turns = 1j * hz[:, None] / self.f_n + np.array([1j, -1j])
        return np.asarray(x / x_over_r + turns * x)

    def members(self, hz: Vector) -> tuple[Response, Response, Response]:
        """The reference z, shape (K, 2), the lines w_l, (K, n, 2), and loads z y of |y| = 1,
        (K, m, 2)."""
        low, high = self.x_over_r
        z = self.line(hz, float(np.sqrt(low * high)))
        others = [z / self.line(hz, x_over_r) for x_over_r in np.geomspace(low, high, _LINES)]
        turns = 1j * hz[:, None] / self.f_n + np.array([1j, -1j])
        loads = [z, z / turns] if self.loads else []
        empty = np.zeros((len(hz), 0, 2), complex)
        return z, np.stack(others, 1), np.stack(loads, 1) if loads else empty


@dataclass(frozen=True)
class Certificate:
    """Whether every network of a class is stable with certain converters.

    Attributes:
        grids: the class.
        hz: ends of the intervals in the dq frame, Hz, shape (K + 1,).
        margin: of each interval the largest t for which diag(m) + He(K M) >= t at both of its ends
            with one K, |Re k|, |Im k| <= 1; relative to the largest entry there, shape (K,).
    """

    grids: GridClass
    hz: Vector
    margin: Vector

    @property
    def holds(self) -> bool:
        """Whether no interval is void."""
        return bool((self.margin > 0.0).all())

    @property
    def void(self) -> list[tuple[float, float]]:
        """The stretches of frequency without a certificate, Hz."""
        found: list[tuple[float, float]] = []
        for low, high, margin in zip(self.hz[:-1], self.hz[1:], self.margin, strict=True):
            if margin <= 0.0:
                joined = found.pop()[0] if found and found[-1][1] == low else float(low)
                found.append((joined, float(high)))
        return found


def certify(
    grids: GridClass,
    hz: Vector,
    admittances: Sequence[Response],
    at: Callable[[Vector], Sequence[Response]] | None = None,
) -> Certificate:
    """Look for a K in each interval of frequency that holds at both of its ends.

    The caller knows that one network of the class is stable with each of the converters.

    Args:
        grids: the class.
        hz: frequencies in the dq frame, ascending, from below the slowest mode to above the fastest
            resonance, shape (K + 1,).
        admittances: Y of each converter at each of its operating points, at ``hz``, (K + 1, 2, 2),
            p.u. of its own rating.
        at: gives them at other frequencies: a void interval is then halved, down to 1e-3 of its
            frequency; None: they were measured, and there are no others.
    """
    Y = np.stack(admittances, 1)
    found: list[tuple[float, float, float]] = []
    waiting = [(hz[k : k + 2], Y[k : k + 2]) for k in reversed(range(len(hz) - 1))]
    while waiting:
        ends, both = waiting.pop()
        margin = _margin(grids, ends, both)
        narrow = ends[1] - ends[0] < _FINEST * ends[1]
        if margin > 0.0 or at is None or narrow or _is_void_at_an_end(grids, ends, both):
            found.append((*ends, margin))
            continue
        middle = np.array([np.sqrt(ends[0] * ends[1])])
        there = np.stack(at(middle), 1)
        waiting += [
            (np.concatenate([middle, ends[1:]]), np.concatenate([there, both[1:]])),
            (np.concatenate([ends[:1], middle]), np.concatenate([both[:1], there])),
        ]
    low, high, margin = np.array(found).T
    return Certificate(grids, np.append(low, high[-1]), margin)


def _is_void_at_an_end(grids: GridClass, ends: Vector, Y: Response) -> bool:
    """Whether no K exists at one of two frequencies, so that halving does not help."""
    return any(_margin(grids, ends[e : e + 1], Y[e : e + 1]) <= 0.0 for e in (0, 1))


def _margin(grids: GridClass, hz: Vector, Y: Response) -> float:
    """The largest t of an interval. Y: at both ends, shape (2, n, 2, 2), or at one frequency."""
    z, lines, loads = grids.members(hz)
    M = z[:, None, :, None] * (_SEQUENCES.conj().T @ Y @ _SEQUENCES)
    size = max(1.0, float(np.abs(M).max()))
    M = M / size
    at_least = loads
    strengths = [grids.weakest, grids.stiffest]
    if np.isinf(grids.stiffest):
        strengths = [grids.weakest]
        at_least = np.concatenate([loads, lines], 1)
    w = np.concatenate([lines * strength / size for strength in strengths], 1)
    # each cut: Re(k_+ c_+) + Re(k_- c_-) >= t; the last number is the factor of t
    cuts = [(c, 0.0) for at_end in at_least for c in _each_sequence(at_end)]
    cuts += [_cut(M[e, 0], np.eye(2)[j], w[e, k, j]) for e in range(len(hz)) for j in (0, 1)
             for k in range(w.shape[1])]  # fmt: skip
    best = -np.inf
    for _ in range(_CUTS):
        rows = np.array([[-c[0].real, c[0].imag, -c[1].real, c[1].imag, t] for c, t in cuts])
        bounds = [(-1.0, 1.0)] * 4 + [(None, None)]
        found = linprog([0, 0, 0, 0, -1], A_ub=rows, b_ub=np.zeros(len(rows)), bounds=bounds)
        k, bound = found.x[:4:2] + 1j * found.x[1:4:2], found.x[4]
        reached, more = _worst(k, M, w)
        best = max(best, reached)
        if bound <= 1e-9 or best >= (1.0 - _CLOSE) * bound:
            break
        cuts += more
    return best if bound > 1e-9 else min(best, 0.0)


def _worst(k: Response, M: Response, w: Response) -> tuple[float, list[tuple[Response, float]]]:
    """The least eigenvalue under K over ends and converters, and the cut of each of them."""
    t, cuts = np.inf, []
    for at_end, lines in zip(M, w, strict=True):
        real = (k * lines).real
        least = real.argmin(axis=0)
        m = real.min(axis=0)
        for one in at_end:
            KM = k[:, None] * one
            values, vectors = np.linalg.eigh(0.5 * (KM + KM.conj().T) + np.diag(m))
            t = min(t, float(values[0]))
            x = vectors[:, 0]
            c = np.abs(x) ** 2 * lines[least, [0, 1]] + x.conj() * (one @ x)
            cuts.append((c, 1.0))
    return t, cuts


def _cut(M: Response, x: Vector, w: complex) -> tuple[Response, float]:
    """That of one direction with one line."""
    return np.abs(x) ** 2 * w + x.conj() * (M @ x), 1.0


def _each_sequence(parts: Response) -> list[Response]:
    """Cuts that keep Re(k c) >= 0 in each sequence; shape (m, 2)."""
    return [np.where(np.eye(2)[j], part, 0.0) for part in parts for j in (0, 1)]
