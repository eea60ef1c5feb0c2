"""The matrices of a sampled loop's tick: with a new u, a hit, and without one, a miss.

In a miss the plant's D/A gets the last u again, or for its first ``extrapolate`` misses in a row
what continues u's trend, as the bench's plant does. What the controller does meanwhile is one of

- ``stands still``: it does not step, since it got no y or did not run;
- ``steps``: it steps as ever, and only its u is lost.

The state is that of the loop, and the u that acts without a new one, where the delay line of u does
not begin with it anyway: x = (plant, delay lines, controller, last u, the two newest u that came).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop

Matrix = NDArray[np.float64]

#: what the controller does in a tick whose u does not come
Meanwhile = Literal["stands still", "steps"]
MEANWHILE: tuple[Meanwhile, ...] = "stands still", "steps"


@dataclass(frozen=True, eq=False)
class Ticks:
    """Hit and misses of one loop: x[k+1] = hit x[k], or misses[i] x[k] in the i-th miss in a row;
    the last of ``misses`` is that of all further ones."""

    hit: Matrix  # shape (n, n)
    misses: tuple[Matrix, ...]  # each (n, n)
    noise: Matrix  # what a disturbance of the grid's voltage adds to x, shape (n,), p.u.
    # y = (v_dc, p, omega_u, q, V) before the sensors is ``outputs`` x in a tick with a new u, shape
    # (5, n), p.u.
    outputs: Matrix
    T_s: float  # s

    def miss(self, i: int) -> Matrix:
        """The matrix of the i-th miss in a row, i from 0."""
        return self.misses[min(i, len(self.misses) - 1)]


def ticks(loop: ClosedLoop, meanwhile: Meanwhile = "steps", extrapolate: int = 0) -> Ticks:
    """The ticks of a single sampled loop.

    Args:
        loop: of a law and a plant.
        meanwhile: what the controller does in a miss.
        extrapolate: misses in a row over which the plant continues u's trend.

    Raises:
        ValueError: the loop is continuous.
    """
    if loop.T_s is None:
        raise ValueError("a continuous loop has no ticks; sample it first")
    p, c = loop.held, loop.controller
    n, m, acts = len(p.A), len(c.A), list(loop.commands)
    lines = loop.lines
    kept = [j for j in acts if extrapolate or lines[j].stop == lines[j].start]
    size = n + m + len(kept) * (3 if extrapolate else 1)
    u_last, newest, before = (
        np.arange(size)[n + m + k * len(kept) :][: len(kept)] for k in range(3)
    )
    eye = np.eye(size)
    u_new = np.hstack([c.D @ p.C, c.C, np.zeros((len(c.C), size - n - m))])
    u_held = np.zeros_like(u_new)
    for j in acts:
        u_held[j] = eye[u_last[kept.index(j)] if j in kept else lines[j].start]

    def tick(u: Matrix, steps: bool) -> Matrix:
        out = np.zeros((size, size))
        out[:n, :n] = p.A
        out[:n] += p.B[:, acts] @ u[acts]
        if steps:
            out[n : n + m, :n], out[n : n + m, n : n + m] = c.B @ p.C, c.A
        else:
            out[n : n + m] = eye[n : n + m]
        out[u_last], out[newest], out[before] = u[kept], eye[newest], eye[before]
        return out

    hit = tick(u_new, True)
    u_on = u_held.copy()
    if extrapolate:
        hit[newest], hit[before] = u_new[kept], eye[newest]
        u_on[kept] += eye[newest] - eye[before]
    steps = meanwhile == "steps"
    misses = (*[tick(u_on, steps)] * extrapolate, tick(u_held, steps))
    noise, outputs = np.zeros(size), loop.state_space[2]
    noise[:n] = p.B_d[:, -1]
    return Ticks(hit, misses, noise, np.pad(outputs, ((0, 0), (0, size - n - m))), loop.T_s)
