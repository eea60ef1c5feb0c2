"""One law of the comparison: its gains tuned for the paper's converter, and its loop's margins.

gamma is that of the paper's ideal continuous loop (``PaperProblem``). What a real loop does to the
gains is read off the exact sampled one at T_S: modes, elements and grid with one sample of delay,
the delay from the sample of y to the action of u counted from none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.delays import DelayMargin, overall_delay
from gfm_design.margins.tolerance import Range, element_range
from gfm_design.model.closed_loop import T_S, ClosedLoop, LeastStable, least_stable
from gfm_design.model.linear import LinearLaw, Mode
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import PAPER_WEIGHTS, WeightedChannel
from gfm_design.tuning.gains import Encoding, FreeGain, free_gains
from gfm_design.tuning.paper import PAPER_START, PaperProblem, tune_paper
from gfm_design.tuning.synthesis import UNSTABLE, NotStabilised, Tuned, tune, unstable_cost
from gfm_plant import Plant
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

_DIGITS = 7  # of a tuned gain: what a reader can compare and the search resolves
_LATE_EVALUATIONS, _LATE_STARTS = 20, 2  # times the ideal search's; at the border no polish helps
_SLOWEST = 1e-3  # Hz; what turns more slowly is no oscillation
_SAME_GAMMA = 1e-4  # relative; by so much a gain may change gamma that makes no difference
_NEAR = 0.99  # of the decay asked for
_SAME = 0.03  # relative; so much the others must not cost a channel that is pinned
_SETTLES = 3

ALPHA = 1.0  # 1/s
_SHARES = (1.0, 0.3, 0.1)  # of a polish's step that are tried

Pair = tuple[int, int]  # i, j of a channel
After = tuple[WeightedChannel, ...] | LeastStable
Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class Found:
    """What the search came to.

    Attributes:
        free: names of the gains that were searched.
        before: channels of the file's own gains, or the mode that grows with them.
        ideal: channels of the gains with the least gamma, whether they can be run or not.
        gains: the least gamma of gains that hold sampled and one sample late
            (``LateProblem``), with what is tied to them; None if nothing does.
        after: their channels; or the mode in the way, of what came closest.
        fixed: channels (i, j) whose norm, at omega = 0 or infinity, no gains that hold can lower,
            the largest first; the gains were chosen for the least of the others.
        evaluations, seconds: what the search took.
    """

    free: tuple[str, ...]
    before: After
    ideal: After
    gains: dict[str, float] | None
    after: After
    fixed: tuple[Pair, ...]
    evaluations: int
    seconds: float


@dataclass(frozen=True)
class Stands:
    """The sampled loop at T_S on the nominal converter.

    Attributes:
        worst: the oscillation with the least damping ratio, one sample late.
        sigma: the loop's largest real part one sample late, 1/s.
        delay: how late u may act after the sample of y; 0 if the loop does not hold without delay.
        L_g, R: factors within which it holds one sample late; R is R_f and R_g together.
    """

    worst: Mode
    sigma: float
    delay: DelayMargin
    L_g: Range | None
    R: Range | None


class LateProblem:
    """The paper's problem for gains that can be run: the loop must hold one sample late.

    A problem for ``synthesis.tune``: gamma of the ideal continuous loop; gains whose sampled loop
    decays too slowly, or grows, count as unstable. Without that, the search may end at gains that
    the kernel cannot run: sampling alone takes the LC resonance, lightly damped by the choke,
    across the border.

    Args:
        paper: gamma.
        alpha: every mode decays at least so fast, 1/s.
    """

    def __init__(self, paper: PaperProblem, alpha: float = ALPHA) -> None:
        self.paper, self._alpha = paper, alpha

    def sigma(self, values: Vector) -> Vector:
        """Largest real part of any mode, 1/s, of sets of gains, one a row; inf where no law."""
        law, late = self.paper.law(values), self.paper.late
        good = np.isfinite(law.A).all(axis=(1, 2)) & np.isfinite(law.D).all(axis=(1, 2))
        out = np.full(len(values), np.inf)
        if good.any():
            some = LinearLaw(*(m[good] for m in law.matrices)).sampled(self.paper.T_s)
            out[good] = late.with_law(some).sigma()
        return out

    def __call__(self, values: Vector) -> float:
        """gamma, or what gains cost that do not hold."""
        return float(self.many(values[None, :])[0])

    def many(self, values: Vector) -> Vector:
        """Costs of several, one a row."""
        costs = self.paper.many(values)
        stable = np.flatnonzero(costs < UNSTABLE)
        if len(stable):
            missing = self.sigma(values[stable]) + self._alpha
            costs[stable] = np.where(missing > 0.0, unstable_cost(missing), costs[stable])
        return costs

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """As far towards a lower gamma nearby as the loop holds."""
        step = self.paper.polish(code, point) - point
        tried = np.array([point, *(point + share * step for share in _SHARES)])
        best: Vector = tried[np.argmin(self.many(code.values(tried)))]
        return best


def search(
    file: LawFile,
    seed: int,
    evaluations: int,
    starts: int | None = None,
    progress: Progress = lambda done, best: None,
) -> Found:
    """Tune a law's free gains, first as ``gfmhil design tune`` does, then so that they can be run.

    ``seed``, ``evaluations``, ``starts`` and ``progress`` as for ``tune_paper``.

    The structure of a law can pin a channel at omega = 0 or infinity, whatever its gains: a row 3
    that cannot hold q + V/D_q pins W_41 T_41(0), a P_ref that reaches omega_u unfiltered pins
    W_31 T_31(inf); or gains that would lower it do not hold. Where such a channel is the largest,
    gamma does not tell good gains from bad ones. They are then searched again for the least of the
    other channels, and taken if the pinned ones do not suffer; and so on, as long as the largest
    channel left is at such a limit.

    Raises:
        LawError: the file declares no free gain.
    """
    own = PaperProblem(file, free_gains(file))
    before = _channels(own, np.array([g.start for g in own.gains]))
    gains = free_gains(file, PAPER_START.get(file.name))
    problem = PaperProblem(file, gains)
    free = tuple(g.name for g in gains)
    began = time.perf_counter()

    def from_(values: Vector) -> tuple[FreeGain, ...]:
        return free_gains(file, dict(zip(free, map(float, values), strict=True)))

    def channels_at(values: Vector) -> tuple[WeightedChannel, ...]:
        return PaperProblem(file, from_(values)).channels(values)

    def late(starts: tuple[FreeGain, ...], without: Sequence[Pair] = ()) -> Tuned:
        weights = tuple(w for w in PAPER_WEIGHTS if (w.i, w.j) not in without)
        of = LateProblem(PaperProblem(file, starts, weights=weights))
        return tune(of, starts, seed, _LATE_EVALUATIONS * evaluations, _LATE_STARTS, progress)

    def left(gains: dict[str, float] | None, after: After, fixed: Sequence[Pair] = ()) -> Found:
        seconds = time.perf_counter() - began
        return Found(free, before, ideal, gains, after, tuple(fixed), spent, seconds)

    ideal: After
    spent = 0
    try:
        found = tune_paper(problem, seed, evaluations, starts, progress)
    except NotStabilised as none:
        ideal = least_stable(problem.closed_loop(none.values))
        return left(None, ideal)
    ideal, spent = problem.channels(found.values), found.evaluations
    if LateProblem(problem).sigma(found.values[None])[0] > -ALPHA:
        tried: list[Tuned] = []
        for start in (from_(found.values), gains):
            try:
                tried.append(late(start))
            except NotStabilised as none:
                in_the_way = least_stable(late_loop(file, problem.law.named(none.values)))
        if not tried:
            return left(None, in_the_way)
        spent += sum(t.evaluations for t in tried)
        found = min(tried, key=lambda t: t.cost)
    values = found.values
    for _ in range(_SETTLES):  # a law without integrators in row 3 rests elsewhere with new gains
        if LateProblem(PaperProblem(file, from_(values)), _NEAR * ALPHA)(values) < UNSTABLE:
            break
        again = late(from_(values))
        values, spent = again.values, spent + again.evaluations
    fixed: list[Pair] = []
    while pair := _at_its_limit(channels_at(values), fixed):
        again = late(from_(values), [*fixed, pair])
        spent += again.evaluations
        if not _no_worse(channels_at(again.values), channels_at(values), fixed):
            break
        values, fixed = again.values, [*fixed, pair]
    values = restored(file, values, fixed)
    values = np.array([float(f"{v:.{_DIGITS}g}") for v in values])
    named = problem.law.named(values)
    problem.move_to(named)
    after = problem.channels(values)
    ideal = min(ideal, after, key=gamma)  # the first search may have ended a little above
    return left(named, after, fixed)


def restored(file: LawFile, values: Vector, fixed: Sequence[Pair]) -> Vector:
    """The tuned gains, but those that make no difference to gamma are the file's own again.

    Where row 1 only holds v_dc, and nothing else looks at v_dc, gamma does not see its gains: the
    search leaves them anywhere, where the DC link may collapse in a step. Gains go back one or two
    at a time, as long as gamma and every stage of it without the fixed channels stay.
    """
    own = np.array([g.start for g in free_gains(file)])
    names = [g.name for g in free_gains(file)]
    # the tuned gains may lie on the border, and the operating point is now their own
    here = PaperProblem(file, free_gains(file, dict(zip(names, map(float, values), strict=True))))
    late, old = LateProblem(here, _NEAR * ALPHA), here.channels(values)

    def makes_no_difference(group: tuple[int, ...]) -> bool:
        tried = np.where(np.isin(np.arange(len(own)), group), own, values)
        # not by the search's own gamma, which is a bound from below
        held = late(tried) < UNSTABLE
        return held and _no_worse(here.channels(tried), old, fixed, _SAME_GAMMA)

    moved = [k for k in range(len(own)) if values[k] != own[k]]
    groups = [*combinations(moved, 2), *((k,) for k in moved)]
    while group := next((g for g in groups if makes_no_difference(g)), None):
        values = np.where(np.isin(np.arange(len(own)), group), own, values)
        groups = [g for g in groups if not set(g) & set(group)]
    return values


def as_it_is(file: LawFile) -> Found:
    """A law with its own gains, nothing searched."""
    problem = PaperProblem(file, free_gains(file))
    at = np.array([g.start for g in problem.gains])
    channels = _channels(problem, at)
    named = None if isinstance(channels, LeastStable) else problem.law.named(at)
    free = tuple(g.name for g in problem.gains)
    return Found(free, channels, channels, named, channels, (), 0, 0.0)


def gamma(channels: Sequence[WeightedChannel]) -> float:
    """The largest norm."""
    return max(c.norm for c in channels)


def _at_its_limit(channels: Sequence[WeightedChannel], fixed: Sequence[Pair]) -> Pair | None:
    """The largest channel but ``fixed`` whose peak is at omega = 0 or infinity, if it is as good
    as the largest of all: a search brings others up to one that it cannot lower."""
    left = [c for c in channels if (c.i, c.j) not in fixed]
    worst = max(c.norm for c in left)
    ends = [c for c in left if c.omega in (0.0, np.inf) and c.norm >= (1 - _SAME) * worst]
    if not ends:
        return None
    largest = max(ends, key=lambda c: c.norm)
    return largest.i, largest.j


def _no_worse(
    new: Sequence[WeightedChannel],
    old: Sequence[WeightedChannel],
    fixed: Sequence[Pair],
    by: float = _SAME,
) -> bool:
    """gamma, and the largest of what is left of it without each of ``fixed`` in turn."""

    def largest(channels: Sequence[WeightedChannel], without: Sequence[Pair]) -> float:
        return gamma([c for c in channels if (c.i, c.j) not in without])

    stages = [fixed[:k] for k in range(len(fixed) + 1)]
    return all(largest(new, out) <= (1 + by) * largest(old, out) for out in stages)


def _channels(problem: PaperProblem, values: Vector) -> After:
    try:
        return problem.channels(values)
    except Unstable:
        return least_stable(problem.closed_loop(values))


def late_loop(file: LawFile, gains: Mapping[str, float]) -> ClosedLoop:
    """A law at some gains on the nominal converter, sampled at T_S, one sample late."""
    plant = Plant.model_validate({"delay": {"samples": 1}})
    return ClosedLoop.of(build_law(file, gains), plant)


def stands(file: LawFile, gains: dict[str, float]) -> Stands:
    """What the sampled loop of a law at some gains stands; takes some seconds."""
    late = late_loop(file, gains)
    modes = late.modes()
    worst = min((m for m in modes if m.frequency_hz > _SLOWEST), key=lambda m: m.ratio)
    sigma = modes[0].sigma
    return Stands(
        worst,
        sigma,
        overall_delay(ClosedLoop(late.plant, late.law, T_S)),
        element_range(late, ("L_g",)) if sigma < 0.0 else None,
        element_range(late, ("R_f", "R_g")) if sigma < 0.0 else None,
    )
