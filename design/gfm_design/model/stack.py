"""Many sampled loops at once, for a search that asks thousands of times.

What does not depend on the law's gains, the held plant from tick to tick, is computed once; for new
gains only the law's few states are discretised, and all loops of one shape are set up together, so
that their eigenvalues are one call. Small signals, p.u. and s, exactly ``model.linear``'s.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.box import T_S, Point
from gfm_design.model.linear import LinearLaw, hold, linearise_plant
from gfm_design.model.operating_point import operating_point
from gfm_plant import make_plant
from gfm_runtime.signals import NU, REF_NAMES
from gfm_runtime.tustin import DiscreteLaw

Matrix = NDArray[np.float64]

_P_REF = REF_NAMES.index("P_ref")
_SENSORS = 4
_P = 1  # place of p among the sensors
_GRIDS = ((10, 16), (120, 16))  # stride in ticks, root of the points: to 0.26 s, to 3.1 s


@dataclass(frozen=True)
class _Held:
    """A plant from tick to tick: x' = F x + old u[k-d-1] + new u[k-d]; p = true_p x."""

    F: Matrix
    old: Matrix
    new: Matrix
    C: Matrix
    true_p: Matrix
    shape: tuple[int, bool, bool]  # whole samples d, a fraction on top, DC source controlled


def _held(point: Point, law: DiscreteLaw) -> _Held:
    par, _ = make_plant(replace(point, delay=0.0).plant(), T_S)  # the delay is put in below
    op = operating_point(par, law, point.references())
    plant = linearise_plant(par, op)
    whole, controlled = int(point.delay), point.dc == "controlled"
    old = (point.delay - whole) * T_S
    to_switch, by_old = hold(plant.A, plant.B, old)
    to_end, by_new = hold(plant.A, plant.B, T_S - old)
    true_p = plant.A[_P - _SENSORS] / par[0]["omega_s"]  # what drives the sensor of p
    true_p[-_SENSORS:] = 0.0
    shape = (whole, old > 0.0, controlled)
    return _Held(to_end @ to_switch, to_end @ by_old, by_new, plant.C, true_p, shape)


class Stack:
    """Loops of one shape: from tick to tick, for a law.

    Attributes:
        members: their places in the list of points.
        controlled: whether row 1 of the law is in force.
        true_p: of every loop, p as a map of the plant's state, shape (N,n).
    """

    def __init__(self, held: Sequence[_Held], members: Sequence[int]) -> None:
        self.members = np.asarray(members)
        self._whole, self._fraction, self.controlled = held[0].shape
        self._F, self._old, self._new, self._C, self.true_p = (
            np.stack([getattr(h, name) for h in held])
            for name in ("F", "old", "new", "C", "true_p")
        )

    def loops(self, law: LinearLaw) -> tuple[Matrix, Matrix]:
        """Loop matrices (N,size,size) and what P_ref adds to the state (N,size).

        State: plant, law, u[k-1], u[k-2], ...; the law must be discrete.
        """
        (N, n, _), m = self._F.shape, len(law.A)
        oldest = self._whole + self._fraction
        size = n + m + NU * oldest
        lines = np.zeros((N, NU * (oldest + 1), size))  # u[k], u[k-1], ... as maps of the state
        lines[:, :NU, :n], lines[:, :NU, n : n + m] = law.D @ self._C, law.C
        lines[:, NU:, n + m :] = np.eye(NU * oldest)
        out, by_ref = np.zeros((N, size, size)), np.zeros((N, size))
        out[:, :n, :n] = self._F
        out[:, :n] += self._new @ lines[:, NU * self._whole : NU * (self._whole + 1)]
        if self._fraction:
            out[:, :n] += self._old @ lines[:, NU * oldest :]
        out[:, n : n + m, :n], out[:, n : n + m, n : n + m] = law.B @ self._C, law.A
        out[:, n + m :] = lines[:, : NU * oldest]
        by_ref[:, n : n + m] = law.B_r[:, _P_REF]
        if oldest:
            by_ref[:, n + m : n + m + NU] = law.D_r[:, _P_REF]
        if not self._whole:
            by_ref[:, :n] = self._new @ law.D_r[:, _P_REF]
        return out, by_ref


def stacks(points: Iterable[Point], law: DiscreteLaw) -> Iterator[Stack]:
    """The loops of all points, those of one shape together.

    Args:
        points: of the box.
        law: its error map must be linear and its rows 1 and 3 integrate, so that the operating
            point of each point does not move with the gains.
    """
    held = [_held(point, law) for point in points]
    for shape in sorted({h.shape for h in held}):
        members = [k for k, h in enumerate(held) if h.shape == shape]
        yield Stack([held[k] for k in members], members)


def tustin(law: LinearLaw, T_s: float = T_S) -> LinearLaw:
    """A continuous law at a sampling time, as ``gfm_runtime.tustin`` makes it."""
    half = T_s / 2
    eye = np.eye(len(law.A))
    backward = np.linalg.inv(eye - half * law.A)
    C = law.C @ backward
    return LinearLaw(
        backward @ (eye + half * law.A),
        2 * half * backward @ law.B,
        C,
        law.D + half * C @ law.B,
        2 * half * backward @ law.B_r,
        law.D_r + half * C @ law.B_r,
    )


def overshoot(stack: Stack, loops: Matrix, by_ref: Matrix) -> Matrix:
    """How far p goes beyond a unit step of P_ref, shape (N,); inf where it grows.

    p = c M^k x_0 on a grid of ticks, of which c M^i and M^(N j) x_0 are the two factors.

    Args:
        stack: the loops.
        loops, by_ref: from ``Stack.loops``.
    """
    count, size, _ = loops.shape
    n = stack.true_p.shape[1]
    rest = np.linalg.solve(np.eye(size) - loops, by_ref[..., None])
    row = np.zeros((count, 1, size))
    row[:, 0, :n] = stack.true_p
    p_end = (row @ rest)[:, 0, 0]
    beyond = np.zeros(count)
    last, power, ticks = -rest, loops, 1
    for stride, side in _GRIDS:
        power = np.linalg.matrix_power(power, stride // ticks)
        ticks = stride
        rows, columns = [row], [-rest]
        for _ in range(side - 1):
            rows.append(rows[-1] @ power)
        leap = np.linalg.matrix_power(power, side)
        for _ in range(side - 1):
            columns.append(leap @ columns[-1])
        p = np.concatenate(rows, axis=1) @ np.concatenate(columns, axis=2)
        beyond = np.maximum(beyond, p.max(axis=(1, 2)) / p_end)
        last = leap @ columns[-1]
    return np.where(np.abs(last).max(axis=(1, 2)) < 1.0, beyond, np.inf)
