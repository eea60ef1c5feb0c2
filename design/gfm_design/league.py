"""One law of the league: its free gains tuned for the paper's converter, and what its loop stands.

gamma is that of the paper's ideal continuous loop (``PaperProblem``). What a real loop does to the
gains is read off the exact sampled one at T_S: modes, elements and grid with one sample of delay,
the delay from the sample of y to the action of u counted from none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.case import Case
from gfm_design.delays import DelayMargin, overall_delay
from gfm_design.gains import free_gains
from gfm_design.hinf import Unstable
from gfm_design.league_modes import Culprit, culprit
from gfm_design.linear import Mode
from gfm_design.paper_problem import PAPER_START, REFERENCES, PaperProblem
from gfm_design.paper_tune import tune_paper
from gfm_design.performance import PAPER_WEIGHTS, Channel
from gfm_design.sampled import SampledLoop
from gfm_design.synthesis import NotStabilised
from gfm_design.tolerance import Range, element_range, mode_of
from gfm_plant import Plant
from gfm_runtime.discretise import discretise
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

T_S = 1e-4  # s
_DIGITS = 7  # of a tuned gain: what a reader can compare and the search resolves
_SLOWEST = 1e-3  # Hz; what turns more slowly is no oscillation
_DROOP = (4, 1)  # the channel from P_ref to q + V/D_q
_WITHOUT_DROOP = tuple(w for w in PAPER_WEIGHTS if (w.i, w.j) != _DROOP)
_SAME = 1e-3  # relative; by so much gamma may suffer
_GONE = 1e-9  # |z| below this is an emptied delay line

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class Found:
    """What the search came to.

    Attributes:
        free: names of the gains that were searched.
        before: channels of the file's own gains, or the mode that grows with them.
        gains: the tuned ones with what is tied to them, or None if nothing holds.
        after: channels of the tuned gains; or, of all that was tried, the mode that grows least.
        droop_fixed: W_41 has its norm at omega = 0 whatever the gains, so that they were chosen
            for the least of the other channels.
        evaluations, seconds: what the search took.
    """

    free: tuple[str, ...]
    before: tuple[Channel, ...] | Culprit
    gains: dict[str, float] | None
    after: tuple[Channel, ...] | Culprit
    droop_fixed: bool
    evaluations: int
    seconds: float


@dataclass(frozen=True)
class Stands:
    """The sampled loop at T_S on the nominal converter.

    Attributes:
        order: states of Phi.
        worst: the oscillation with the least damping ratio, one sample late.
        sigma: the loop's largest real part one sample late, 1/s.
        delay: how late u may act after the sample of y, or None if the loop does not even hold
            without delay.
        L_g, R: factors within which it holds one sample late; R is R_f and R_g together.
    """

    order: int
    worst: Mode
    sigma: float
    delay: DelayMargin | None
    L_g: Range | None
    R: Range | None


def search(
    file: LawFile,
    seed: int,
    evaluations: int,
    starts: int,
    progress: Progress = lambda done, best: None,
) -> Found:
    """Tune a law's free gains as ``gfmhil design tune`` does.

    A law whose row 3 cannot hold q + V/D_q has a W_41 T_41(0) that no gain changes. Once that is
    the largest channel gamma no longer tells good gains from bad ones; they are then searched
    again for the least of the other channels, and taken if gamma does not suffer.

    Raises:
        LawError: the file declares no free gain.
    """
    own = PaperProblem(file, free_gains(file))
    before = _channels(own, np.array([g.start for g in own.gains]))
    problem = PaperProblem(file, free_gains(file, PAPER_START.get(file.name)))
    free = tuple(g.name for g in problem.gains)
    began = time.perf_counter()
    try:
        found = tune_paper(problem, seed, evaluations, starts, progress)
    except NotStabilised as none:
        seconds = time.perf_counter() - began
        return Found(free, before, None, culprit(problem, none.values), False, 0, seconds)
    values, spent, fixed = found.values, found.evaluations, False
    if _by_droop(problem.channels(values)):
        others = PaperProblem(file, problem.gains, weights=_WITHOUT_DROOP)
        again = tune_paper(others, seed, evaluations, starts, progress)
        spent += again.evaluations
        if gamma(problem.channels(again.values)) <= (1 + _SAME) * gamma(problem.channels(values)):
            values, fixed = again.values, True
    values = np.array([float(f"{v:.{_DIGITS}g}") for v in values])
    named = problem.law.named(values)
    problem.move_to(named)
    after = problem.channels(values)
    return Found(free, before, named, after, fixed, spent, time.perf_counter() - began)


def as_it_is(file: LawFile) -> Found:
    """A law with its own gains, nothing searched."""
    problem = PaperProblem(file, free_gains(file))
    at = np.array([g.start for g in problem.gains])
    channels = _channels(problem, at)
    named = None if isinstance(channels, Culprit) else problem.law.named(at)
    free = tuple(g.name for g in problem.gains)
    return Found(free, channels, named, channels, False, 0, 0.0)


def gamma(channels: Sequence[Channel]) -> float:
    """The largest norm."""
    return max(c.norm for c in channels)


def _by_droop(channels: Sequence[Channel]) -> bool:
    """The largest channel is W_41, at rest."""
    worst = max(channels, key=lambda c: c.norm)
    return (worst.i, worst.j) == _DROOP and worst.omega == 0.0


def _channels(problem: PaperProblem, values: Vector) -> tuple[Channel, ...] | Culprit:
    try:
        return problem.channels(values)
    except Unstable:
        return culprit(problem, values)


def stands(file: LawFile, gains: dict[str, float]) -> Stands:
    """What the sampled loop of a law at some gains stands; takes some seconds."""
    law = discretise(build_law(file, gains), T_S)
    case = Case(Plant.model_validate({"delay": {"samples": 1}}), law, np.array(REFERENCES))
    late = case.loop()
    z = np.linalg.eigvals(late.closed()).astype(complex)
    modes = [mode_of(complex(v), T_S) for v in z[np.abs(z) > _GONE]]
    worst = min((m for m in modes if m.frequency_hz > _SLOWEST), key=lambda m: m.ratio)
    sigma = max(m.sigma for m in modes)
    prompt = SampledLoop(late.plant, late.law, T_S, 0.0)
    holds = bool(np.abs(np.linalg.eigvals(prompt.closed())).max() < 1.0)
    return Stands(
        law.order,
        worst,
        sigma,
        overall_delay(prompt) if holds else None,
        element_range(case, ("L_g",)) if sigma < 0.0 else None,
        element_range(case, ("R_f", "R_g")) if sigma < 0.0 else None,
    )
