"""The last steps to a least gamma: linear programs over the active peaks.

Near a minimum several peaks are equally high. Each peak's height has a gradient in the gains, for
the loop's matrices are (nearly) affine in them. One over the height is closer to linear than the
height, since a resonance's peak goes as one over its damping; so each step raises the least of
1/height over all peaks by a linear program within a trust region, and is taken if the true peaks
agree.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_design.performance import StateSpace, Weight

Vector = NDArray[np.float64]

_GRID = np.concatenate([[0.0], np.logspace(-3, 5.5, 320)])
_ACROSS = np.array([-3.0, -1.5, -0.7, -0.3, -0.1, 0.0, 0.1, 0.3, 0.7, 1.5, 3.0])
_TALL = 0.6  # peaks above this share of the highest take part
_SMALLEST = 1e-4  # trust region, in the search's coordinates
_ACCEPTED = 0.1  # share of the promised improvement


class Peak(NamedTuple):
    """A local maximum of |W_ij T_ij|: its height, and the height's slope over each coordinate."""

    height: float
    slope: Vector


def polish(
    loops: Callable[[Vector], StateSpace],
    weights: tuple[Weight, ...],
    start: Vector,
    low: Vector,
    high: Vector,
    rounds: int = 100,
) -> Vector:
    """Coordinates near ``start``, within [low, high], at which the highest peak is least.

    Args:
        loops: T(s) at given coordinates, stacked on axis 0 if they are.
        weights: W_ij.
        start: a stable point; an unstable one comes back as it is.
        rounds: steps at most.
    """
    from scipy.optimize import linprog

    at, reach = np.clip(start, low, high), 0.1
    now = _peaks(loops, weights, at)
    while now and rounds > 0 and reach > _SMALLEST:
        rounds -= 1
        inverse = np.array([1.0 / p.height for p in now])
        slopes = np.array([-p.slope / p.height**2 for p in now])
        box = [*zip(np.maximum(low - at, -reach), np.minimum(high - at, reach), strict=True)]
        program = linprog(
            np.r_[np.zeros(len(at)), -1.0],
            A_ub=np.hstack([-slopes, np.ones((len(now), 1))]),
            b_ub=inverse,
            bounds=[*box, (None, None)],
            method="highs",
        )
        if program.status != 0:
            break
        step = program.x[:-1]
        promised = (inverse + slopes @ step).min() - inverse.min()
        if promised <= 1e-9 * inverse.min():
            break
        then = _peaks(loops, weights, at + step)
        gained = 1.0 / max(p.height for p in then) - inverse.min() if then else -np.inf
        if gained > _ACCEPTED * promised:
            at, now = at + step, then
            reach *= 2.0 if gained > 0.7 * promised else 1.0
        else:
            reach /= 2.5
    return np.clip(at, low, high)


def _peaks(
    loops: Callable[[Vector], StateSpace], weights: tuple[Weight, ...], at: Vector
) -> list[Peak]:
    """The tall peaks of every channel; none if the loop is unstable."""
    A, B, C, D = loops(at)
    values, vectors = np.linalg.eig(A)
    if values.real.max() >= 0.0:
        return []
    inverse = np.linalg.inv(vectors)
    near = np.abs(values.imag[:, None] + _ACROSS * values.real[:, None]).ravel()
    omega = np.unique(np.concatenate([_GRID, near, np.abs(values)]))
    found: list[tuple[float, float, Weight]] = []
    for w in weights:
        residues = (C[w.i - 1] @ vectors) * (inverse @ B[:, w.j - 1])

        def size(omega: Vector, w: Weight = w, residues: Vector = residues) -> Vector:
            response = (1.0 / (1j * omega[:, None] - values)) @ residues + D[w.i - 1, w.j - 1]
            return np.abs(response * w(1j * omega))

        found += [(*p, w) for p in _tops(omega, size)]
    highest = max(height for height, _, _ in found)
    tall = [p for p in found if p[0] > _TALL * highest]
    if not tall:
        return []
    slopes = _loop_slopes(loops, at)
    modes = values, vectors, inverse
    return [Peak(height, _slope(modes, (B, C, D), slopes, w, x)) for height, x, w in tall]


def _tops(omega: Vector, size: Callable[[Vector], Vector]) -> list[tuple[float, float]]:
    """(height, frequency) of the local maxima along omega, each looked at three times closer."""
    g = size(omega)
    padded = np.concatenate([[-np.inf], g, [-np.inf]])
    tops = np.flatnonzero((g >= padded[:-2]) & (g > padded[2:]) & (g > 0.0))
    out = []
    for k in tops.tolist():
        best = (float(g[k]), float(omega[k]))
        low, high = float(omega[max(k - 1, 0)]), float(omega[min(k + 1, len(omega) - 1)])
        for _ in range(3):
            x = np.linspace(low, high, 9)
            y = size(x)
            j = int(np.argmax(y))
            if y[j] > best[0]:
                best = (float(y[j]), float(x[j]))
            low, high = float(x[max(j - 1, 0)]), float(x[min(j + 1, 8)])
        out.append(best)
    return out


def _loop_slopes(loops: Callable[[Vector], StateSpace], at: Vector) -> StateSpace:
    """The loop's matrices differentiated by each coordinate (axis 0), by central differences."""
    steps = 1e-5 * np.eye(len(at))
    stacked = loops(np.vstack([at + steps, at - steps]))
    A, B, C, D = ((m[: len(at)] - m[len(at) :]) / 2e-5 for m in stacked)
    return A, B, C, D


def _slope(
    modes: tuple[Vector, Vector, Vector],
    matrices: tuple[Vector, Vector, Vector],
    slopes: StateSpace,
    w: Weight,
    omega: float,
) -> Vector:
    """d|W T|/dx at a fixed frequency, which at a peak is the slope of the height."""
    values, vectors, inverse = modes
    B, C, D = matrices
    i, j, gain = w.i - 1, w.j - 1, 1.0 / (1j * omega - values)
    right = vectors @ (gain * (inverse @ B[:, j]))
    left = ((C[i] @ vectors) * gain) @ inverse
    T = C[i] @ right + D[i, j]
    dA, dB, dC, dD = slopes
    dT = dC[:, i] @ right + (dA @ right) @ left + dB[:, :, j] @ left + dD[:, i, j]
    weight = np.abs(w(np.array([1j * omega])))[0]
    return np.asarray(weight * (np.conj(T) * dT).real / np.abs(T))
