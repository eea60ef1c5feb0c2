"""Gains that stabilise the box: tune on a few of its corners, add violated ones, and repeat.

The box has a thousand corners, most of which never bind. A round searches with the corners found
so far. Then all corners are evaluated, and the worst violated ones are added.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from deployable.box import Box, Point, Source
from deployable.robust import Loops, RobustProblem, Wanted, paper_problem
from gfm_design.tuning.gains import FreeGain
from gfm_design.tuning.synthesis import tune
from gfm_runtime.lawfile import LawFile

Vector = NDArray[np.float64]

_JOIN, _JOIN_STEPS = 12, 5  # violated corners that are added after a round
_TOLERANCE = 1e-3
#: samples: delays at which the nominal loop must be stable, too; behind an inner stage it cannot
#: be, because the current loop comes first
LATE = (7.0, 9.0, 11.0)


@dataclass(frozen=True)
class Round:
    """The state of the search after a round: gains, gamma, and the worst over the whole box.

    ``slow`` [1/s] and ``beyond`` (as a fraction of the step) are the worst violations of the limits
    of sigma and of the overshoot; they are negative if all corners meet the limits.
    """

    values: Vector
    gamma: float
    sigma: float
    overshoot: float
    slow: float
    beyond: float
    points: int
    seconds: float


def steps(box: Box) -> list[Point]:
    """The points for the step of P_ref: from 0.5 p.u., at the smallest and the largest delay."""
    return replace(box, P_ref=(0.5,), delay=(min(box.delay), max(box.delay))).corners()


def deploy(
    file: LawFile,
    gains: Sequence[FreeGain],
    box: Box,
    wanted: Wanted,
    seed: int = 0,
    rounds: int = 6,
    evaluations: int = 3000,
    starts: int = 2,
    tell: Callable[[Round], None] = lambda found: None,
) -> Round:
    """Tune gains for a box and return the last round; a seed always gives the same gains.

    Args:
        file, gains: the law and its free gains; their starts must stabilise the paper's loop.
        box: the loops that the gains must stabilise.
        wanted: the constraints.
        seed: of the search.
        rounds: most rounds.
        evaluations, starts: of each round, as for ``tune``.
        tell: called after every round.
    """
    begin = time.perf_counter()
    lates = LATE if file.inner is None else ()
    corners = box.corners() + [Point(delay=late, dc=dc) for dc in box.dc for late in lates]
    stepped = steps(box)
    extremes = [p for p in corners if _is_extreme(p, box)]
    points = [*extremes, *corners[len(box.corners()) :]]
    over = [p for p in stepped if p.R_f == p.R_g and p.R_f >= 1.0 and p.delay == max(box.delay)]
    over = over or stepped  # a box without such resistances
    everywhere, every_step = Loops(file, gains, corners), Loops(file, gains, stepped)
    allowed = np.array([wanted.sigma(p) for p in corners])
    limits = np.array([wanted.overshoot(p) for p in stepped])
    for k in range(rounds):
        # a law for the rig alone is tuned for the paper's problem on the rig
        source: Source = "controlled" if "controlled" in box.dc else "regulated"
        paper = paper_problem(file, gains, source)
        found = tune(
            RobustProblem(paper, points, over, wanted), gains, seed + k, evaluations, starts
        )
        sigma, beyond = everywhere.sigma(found.values), every_step.overshoot(found.values)
        joining = _worst(corners, sigma - allowed, points, _JOIN)
        joining_steps = _worst(stepped, beyond - limits, over, _JOIN_STEPS)
        now = Round(
            found.values,
            paper(found.values),
            float(sigma.max()),
            float(beyond.max()),
            float((sigma - allowed).max()),
            float((beyond - limits).max()),
            len(points),
            time.perf_counter() - begin,
        )
        tell(now)
        if not joining and not joining_steps:
            break
        points, over = points + joining, over + joining_steps
        gains = [replace(g, start=float(v)) for g, v in zip(gains, found.values, strict=True)]
    return now


def _worst(all_of: Sequence[Point], broken: Vector, known: list[Point], most: int) -> list[Point]:
    order = [int(k) for k in np.argsort(-broken) if broken[k] > _TOLERANCE]
    return [all_of[k] for k in order if all_of[k] not in known][:most]


def _is_extreme(point: Point, box: Box) -> bool:
    """Whether a point is among the outermost corners with which the search begins: half of them,
    since P_ref alternates between its two ends."""
    ends = {n: (min(getattr(box, n)), max(getattr(box, n))) for n in ("R_f", "R_g", "L_g", "delay")}
    if any(getattr(point, n) not in ends[n] for n in ends):
        return False
    high = sum(getattr(point, n) == ends[n][1] for n in ("R_f", "R_g", "delay"))
    return point.P_ref == (max(box.P_ref) if high % 2 else min(box.P_ref))
