"""One law of the comparison: its gains tuned for the paper's converter, and its loop's margins.

gamma is that of the paper's ideal continuous loop (``PaperProblem``). The modes and the tolerances
of elements and grid are those of the exact loop sampled at T_S with one sample of delay. The delay
margin counts from the sample of y to the action of u.
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
from gfm_design.model.closed_loop import T_S, ClosedLoop
from gfm_design.model.linear import Mode
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.performance import PAPER_WEIGHTS, Channel
from gfm_design.tuning.gains import FreeGain, free_gains
from gfm_design.tuning.law_comparison_late import ALPHA, LateProblem
from gfm_design.tuning.law_comparison_modes import Culprit, culprit
from gfm_design.tuning.paper_problem import PAPER_START, PaperProblem
from gfm_design.tuning.paper_tune import tune_paper
from gfm_design.tuning.synthesis import UNSTABLE, NotStabilised, Tuned, tune
from gfm_plant import Plant
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

_DIGITS = 7  # of a tuned gain: the search resolves no more
# evaluations relative to the ideal search: at the limit of stability no polish helps
_LATE_EVALUATIONS, _LATE_STARTS = 20, 2
_SLOWEST = 1e-3  # Hz; a slower mode does not count as an oscillation
_SAME_GAMMA = 1e-4  # relative change of gamma below which a gain makes no difference
_NEAR = 0.99  # of the required decay
_SAME = 0.03  # relative: by less than this the pinned channels may grow
_SETTLES = 3

Pair = tuple[int, int]  # i, j of a channel
After = tuple[Channel, ...] | Culprit
Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class Found:
    """The result of the search.

    Attributes:
        free: names of the gains that were searched.
        before: channels of the file's own gains, or the mode that grows with them.
        ideal: channels of the gains with the least gamma, even if the kernel cannot run them.
        gains: those with the least gamma whose sampled loop is stable with one sample of delay
            (``tuning.law_comparison_late``), and all parameters tied to them; None if there are
            none.
        after: their channels, or the least stable mode of the best gains that were tried.
        fixed: channels (i, j) whose norm, at omega = 0 or infinity, no stabilising gains can lower,
            the largest first; the gains minimise the largest of the others.
        evaluations, seconds: the effort of the search.
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
        worst: the oscillation with the lowest damping ratio, with one sample of delay.
        sigma: the largest real part of a mode with one sample of delay, 1/s.
        delay: from the sample of y to the action of u; 0 if the loop is unstable without delay.
        L_g, R: factors within which the loop is stable with one sample of delay; R is R_f and R_g
            together.
    """

    worst: Mode
    sigma: float
    delay: DelayMargin
    L_g: Range | None
    R: Range | None


def search(
    file: LawFile,
    seed: int,
    evaluations: int,
    starts: int | None = None,
    progress: Progress = lambda done, best: None,
) -> Found:
    """Tune a law's free gains, first as ``gfmhil design tune`` does, then for the sampled loop.

    ``seed``, ``evaluations``, ``starts`` and ``progress`` as for ``tune_paper``.

    The structure of a law can pin a channel at omega = 0 or infinity, whatever its gains: a row 3
    that cannot hold q + V/D_q pins W_41 T_41(0), and a P_ref that reaches omega_u unfiltered pins
    W_31 T_31(inf). Or the gains that would lower the channel make the loop unstable. If such a
    channel is the largest, gamma does not distinguish good gains from bad ones. The search then
    minimises the largest of the other channels, and keeps the result if the pinned channels do not
    grow. It repeats this as long as the largest channel left is at such a limit.

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

    def channels_at(values: Vector) -> tuple[Channel, ...]:
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
        ideal = culprit(problem.closed_loop(none.values))
        return left(None, ideal)
    ideal, spent = problem.channels(found.values), found.evaluations
    if LateProblem(problem).sigma(found.values[None])[0] > -ALPHA:
        tried: list[Tuned] = []
        for start in (from_(found.values), gains):
            try:
                tried.append(late(start))
            except NotStabilised as none:
                culprit_late = culprit(late_loop(file, problem.law.named(none.values)))
        if not tried:
            return left(None, culprit_late)
        spent += sum(t.evaluations for t in tried)
        found = min(tried, key=lambda t: t.cost)
    values = found.values
    for _ in range(_SETTLES):  # without integrators in row 3 the operating point depends on gains
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
    ideal = min(ideal, after, key=gamma)  # the first search may have ended slightly above
    return left(named, after, fixed)


def restored(file: LawFile, values: Vector, fixed: Sequence[Pair]) -> Vector:
    """The tuned gains, except that gains without influence on gamma return to the file's values.

    If row 1 only controls v_dc, and no other row uses v_dc, gamma does not depend on its gains: the
    search leaves them at arbitrary values, with which the DC link may collapse in a step. Gains
    return one or two at a time, as long as gamma and the largest of the channels that are not fixed
    stay the same.
    """
    own = np.array([g.start for g in free_gains(file)])
    names = [g.name for g in free_gains(file)]
    # at the operating point of the tuned gains, which may lie at the limit of stability
    here = PaperProblem(file, free_gains(file, dict(zip(names, map(float, values), strict=True))))
    late, old = LateProblem(here, _NEAR * ALPHA), here.channels(values)

    def makes_no_difference(group: tuple[int, ...]) -> bool:
        tried = np.where(np.isin(np.arange(len(own)), group), own, values)
        # compare the guaranteed norms: the search's own gamma is a lower bound
        held = late(tried) < UNSTABLE
        return held and _no_worse(here.channels(tried), old, fixed, _SAME_GAMMA)

    moved = [k for k in range(len(own)) if values[k] != own[k]]
    groups = [*combinations(moved, 2), *((k,) for k in moved)]
    while group := next((g for g in groups if makes_no_difference(g)), None):
        values = np.where(np.isin(np.arange(len(own)), group), own, values)
        groups = [g for g in groups if not set(g) & set(group)]
    return values


def as_it_is(file: LawFile) -> Found:
    """A law with the gains of its file, without a search."""
    problem = PaperProblem(file, free_gains(file))
    at = np.array([g.start for g in problem.gains])
    channels = _channels(problem, at)
    named = None if isinstance(channels, Culprit) else problem.law.named(at)
    free = tuple(g.name for g in problem.gains)
    return Found(free, channels, channels, named, channels, (), 0, 0.0)


def gamma(channels: Sequence[Channel]) -> float:
    """The largest norm."""
    return max(c.norm for c in channels)


def _at_its_limit(channels: Sequence[Channel], fixed: Sequence[Pair]) -> Pair | None:
    """The largest channel, apart from ``fixed``, whose peak is at omega = 0 or infinity, if it is
    within 3 % of the largest of all: a search raises others up to one that it cannot lower."""
    left = [c for c in channels if (c.i, c.j) not in fixed]
    worst = max(c.norm for c in left)
    ends = [c for c in left if c.omega in (0.0, np.inf) and c.norm >= (1 - _SAME) * worst]
    if not ends:
        return None
    largest = max(ends, key=lambda c: c.norm)
    return largest.i, largest.j


def _no_worse(
    new: Sequence[Channel], old: Sequence[Channel], fixed: Sequence[Pair], by: float = _SAME
) -> bool:
    """Whether neither gamma nor the largest norm without the first 1, 2, … of ``fixed`` grows."""

    def largest(channels: Sequence[Channel], without: Sequence[Pair]) -> float:
        return gamma([c for c in channels if (c.i, c.j) not in without])

    stages = [fixed[:k] for k in range(len(fixed) + 1)]
    return all(largest(new, out) <= (1 + by) * largest(old, out) for out in stages)


def _channels(problem: PaperProblem, values: Vector) -> After:
    try:
        return problem.channels(values)
    except Unstable:
        return culprit(problem.closed_loop(values))


def late_loop(file: LawFile, gains: Mapping[str, float]) -> ClosedLoop:
    """A law at given gains on the nominal converter, sampled at T_S with one sample of delay."""
    plant = Plant.model_validate({"delay": {"samples": 1}})
    return ClosedLoop.of(build_law(file, gains), plant)


def stands(file: LawFile, gains: dict[str, float]) -> Stands:
    """The margins of the sampled loop of a law at given gains; takes some seconds."""
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
