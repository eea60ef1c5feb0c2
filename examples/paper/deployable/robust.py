"""Gains that stabilise a whole box of real loops: the constraints, and the cost of a search.

The search minimises gamma of the paper's problem under constraints over the box: every mode of
every sampled loop decays faster than alpha, and the overshoot of p after a step of P_ref stays
below a limit. The penalty of a violation exceeds what gamma can gain by it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deployable.box import SOURCES, Point, Source
from gfm_design.model.closed_loop import INPUTS, T_S, ClosedLoop
from gfm_design.tuning.gains import Encoding, FreeGain, GainedLaw
from gfm_design.tuning.paper import PaperProblem
from gfm_design.tuning.synthesis import UNSTABLE
from gfm_plant import Plant
from gfm_runtime.lawfile import LawFile, build_law
from gfm_runtime.signals import Y_NAMES
from gfm_runtime.tustin import discretise

Vector = NDArray[np.float64]

_BROKEN = 5.0  # penalty for 1 1/s of decay too little, and for gamma 1 above its ceiling
_BEYOND = 100.0  # penalty for an overshoot that exceeds its limit by a whole step
_HOPELESS = 20.0  # 1/s; the step response of a loop that grows faster is not computed
_GRIDS = ((10, 16), (120, 16))  # stride in ticks, root of the number of points: 0.26 s and 3.1 s
_P_REF, _P = INPUTS.index("P_ref"), Y_NAMES.index("p")
_SHORT = 3.0  # L_g up to this factor counts as a strong grid


@dataclass(frozen=True)
class Wanted:
    """The constraints for every loop of the box.

    Attributes:
        gamma: ceiling of gamma; above it gamma has a penalty.
        alpha: least decay rate of every mode, 1/s.
        strong, weak: largest overshoot of p as a fraction of a step of P_ref, up to and beyond
            L_g x 3.
        rig_alpha: as alpha, for a DC source that regulates itself; None: alpha and the limits of
            the overshoot hold there, too.
        rig_weight: with a rig_alpha, the cost of an overshoot of 1 (a whole step) on the rig.
    """

    gamma: float = 1.49
    alpha: float = 1.1
    strong: float = 0.025
    weak: float = 0.15
    rig_alpha: float | None = 0.2
    rig_weight: float = 3.0

    def sigma(self, point: Point) -> float:
        """Largest sigma allowed at a point, 1/s."""
        return -self.alpha if self.rig_alpha is None or not _is_rig(point) else -self.rig_alpha

    def overshoot(self, point: Point) -> float:
        """Largest overshoot allowed at a point; inf where it adds to the cost instead."""
        if self.rig_alpha is not None and _is_rig(point):
            return np.inf
        return self.strong if point.L_g <= _SHORT else self.weak


def _is_rig(point: Point) -> bool:
    return point.dc == "regulated"


class Loops:
    """The sampled loops of some points as functions of a law's free gains.

    The law must have a linear error map and integrators in rows 1 and 3, so that the operating
    points do not depend on the gains. The sampled plants are computed once, and loops of the same
    size are stacked into one ``ClosedLoop``.
    """

    def __init__(self, file: LawFile, gains: Sequence[FreeGain], points: Sequence[Point]) -> None:
        self.points = list(points)
        law = discretise(build_law(file, {g.name: g.start for g in gains}), T_S)
        rest = ClosedLoop.of(law)
        op, ref = rest.made_of.op, rest.made_of.ref
        self._laws = {dc: GainedLaw(file, gains, op, ref, dc == "controlled") for dc in SOURCES}
        loops = [point.loop(law) for point in self.points]
        keys = [(p.dc, loop.held.A.shape) for p, loop in zip(self.points, loops, strict=True)]
        self._stacks: list[tuple[NDArray[np.intp], Source, ClosedLoop]] = []
        for key in sorted(set(keys)):
            members = [k for k, other in enumerate(keys) if other == key]
            stack = ClosedLoop.stacked([loops[k] for k in members])
            self._stacks.append((np.array(members), key[0], stack))

    def sigma(self, values: Vector) -> Vector:
        """Largest real part of any mode at each point, 1/s."""
        return self._each(values, lambda loop: np.asarray(loop.sigma()))

    def overshoot(self, values: Vector) -> Vector:
        """Overshoot of p after a step of P_ref, as a fraction of the step; inf if it grows."""
        return self._each(values, overshoot)

    def _each(self, values: Vector, of: Callable[[ClosedLoop], Vector]) -> Vector:
        laws = {dc: law(values).sampled(T_S) for dc, law in self._laws.items()}
        out = np.empty(len(self.points))
        for members, dc, stack in self._stacks:
            out[members] = of(stack.with_law(laws[dc]))
        return out


def overshoot(loops: ClosedLoop) -> Vector:
    """Overshoot of p after a unit step of P_ref, shape (N,); inf where it grows.

    It is p = c A^k x_0 on a grid of ticks, computed as the products of c A^i and A^(N j) x_0.

    Args:
        loops: N sampled loops, stacked.
    """
    A, B, C, _ = loops.state_space
    rest = np.linalg.solve(np.eye(A.shape[-1]) - A, B[..., [_P_REF]])
    row = C[:, [_P]]
    p_end = (row @ rest)[:, 0, 0]
    beyond = np.zeros(len(A))
    last, power, ticks = -rest, A, 1
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


def paper_problem(file: LawFile, gains: Sequence[FreeGain], dc: Source) -> PaperProblem:
    """The paper's problem with a DC source; a source that regulates itself replaces row 1."""
    plant = Plant.model_validate({"dc_source": {"mode": dc}})
    return PaperProblem(file, tuple(gains), plant)


class RobustProblem:
    """The cost of a law's gains over some points of the box; a problem for ``synthesis.tune``.

    Args:
        paper: computes gamma.
        points: where the modes are constrained.
        steps: where the overshoot is constrained.
        wanted: the constraints.
    """

    def __init__(
        self, paper: PaperProblem, points: Sequence[Point], steps: Sequence[Point], wanted: Wanted
    ) -> None:
        self._paper, self._wanted = paper, wanted
        self._loops = Loops(paper.file, paper.gains, points)
        self._steps = Loops(paper.file, paper.gains, steps)
        self._sigma = np.array([wanted.sigma(p) for p in points])
        self._overshoot = np.array([wanted.overshoot(p) for p in steps])

    def __call__(self, values: Vector) -> float:
        """gamma plus the penalties."""
        gamma = self._paper(values)
        if gamma >= UNSTABLE:
            return gamma
        slow = np.maximum(self._loops.sigma(values) - self._sigma, 0.0)
        cost = gamma + _BROKEN * (max(gamma - self._wanted.gamma, 0.0) + slow.max() + slow.mean())
        beyond = np.ones(len(self._overshoot))
        if slow.max() < _HOPELESS:
            beyond = np.minimum(self._steps.overshoot(values), 1.0)
        rig = np.isinf(self._overshoot)
        over = np.maximum(beyond - self._overshoot, 0.0)
        cost += _BEYOND * (over.max() + over.mean())
        return float(cost + self._wanted.rig_weight * beyond[rig].max(initial=0.0))

    def many(self, values: Vector) -> Vector:
        """Costs of several sets of gains, one a row."""
        return np.array([self(v) for v in values])

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """The point itself: the constraints are not smooth enough for a gradient."""
        return point
