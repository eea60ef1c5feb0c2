"""``design tune``: choose a law's free gains for the least gamma of the paper's problem.

The cost is gamma of the ideal continuous loop. A law with an inner stage has no continuous loop,
since the stage runs from tick to tick. Its gamma is that of the sampled loop with u one sample late
and the weights by Tustin. On a scenario, and so in a network, it is that of the sampled loop with
the delays and sensors there. The searches work on the inverse Tustin transform of such a loop,
which has the same norms.

The search is many short ones, each followed by a polish. The problem has several minima (MIMO-GFM
has one at 1.43 with a fast DC loop and one at 1.33 with a slow one), and the polish converges to
one from far away.

The polish raises the least of 1/height over all high peaks step by step. Near a minimum several
peaks are equally high, along a curved ridge. Each step maximises the least of their second-order
models within a trust region, and is accepted if the true peaks improve as well. The models are of
1/height: the height of a resonance is inversely proportional to its damping, which is nearly linear
in the gains.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import REFERENCES, T_S, ClosedLoop
from gfm_design.model.linear import LinearLaw, LinearPlant, inverse_tustin
from gfm_design.model.operating_point import OperatingPoint
from gfm_design.norms.hinf import Unstable
from gfm_design.norms.peaks import Loops, PeakModel, Screen, model, peaks
from gfm_design.norms.performance import (
    PAPER_WEIGHTS,
    StateSpace,
    Weight,
    WeightedChannel,
    channel_norms,
)
from gfm_design.tuning.gains import Encoding, FreeGain, GainedLaw
from gfm_design.tuning.synthesis import UNSTABLE, NotStabilised, Tuned, tune, unstable_cost
from gfm_plant import NoEquilibrium, Plant
from gfm_runtime.law import BuiltLaw
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

_FIRST, _SMALLEST = 0.3, 1e-4  # first and smallest trust region, in the search's coordinates
_STEEP = 3.0  # how much the slope of ln(height) along a coordinate reduces the region there
_ACCEPTED = 0.1  # least fraction of the predicted improvement for a step to be accepted
_WORTH, _PATIENCE = 1e-4, 6  # least relative improvement over this number of rounds


def polish(
    loops: Loops,
    weights: tuple[Weight, ...],
    start: Vector,
    low: Vector,
    high: Vector,
    rounds: int = 60,
) -> Vector:
    """Coordinates near ``start``, within [low, high], at which the highest peak is least.

    Args:
        loops: T(s) at given coordinates; rows of coordinates give loops stacked on axis 0.
        weights: W_ij.
        start: a stable point; an unstable one is returned unchanged.
        low, high: limits of each coordinate.
        rounds: most steps.
    """
    at, reach = np.clip(start, low, high), _FIRST
    now = peaks(loops(at), weights)
    nearby: PeakModel | None = None
    past: list[float] = []
    while now is not None and len(past) < rounds and reach > _SMALLEST:
        past.append(float(now.height[0]))
        if len(past) > _PATIENCE and past[-1] > (1.0 - _WORTH) * past[-1 - _PATIENCE]:
            break
        if nearby is None:
            nearby = model(loops, weights, at, now)
        # a smaller region along coordinates on which a height depends steeply
        far = reach / (1.0 + _STEEP * np.abs(nearby.slope / nearby.base[:, None]).max(axis=0))
        step = _best_step(nearby, np.maximum(low - at, -far), np.minimum(high - at, far))
        least = nearby.base.min()
        promised = nearby(step).min() - least
        if promised <= 1e-9 * least:
            break
        then = peaks(loops(at + step), weights)
        gained = 1.0 / then.height[0] - least if then is not None else -np.inf
        if gained > _ACCEPTED * promised:
            at, now, nearby = at + step, then, None
            if gained > 0.7 * promised and np.abs(step / far).max() > 0.9:
                reach *= 2.0
        else:
            reach *= np.abs(step / far).max() / 3.0
    return np.clip(at, low, high)


def _best_step(nearby: PeakModel, low: Vector, high: Vector) -> Vector:
    """The step in [low, high] after which the least of the models is greatest."""
    from scipy.optimize import minimize

    n = len(low)
    found = minimize(
        lambda z: -z[n],
        np.r_[np.zeros(n), nearby.base.min()],
        jac=lambda z: np.r_[np.zeros(n), -1.0],
        bounds=[*zip(low, high, strict=True), (None, None)],
        constraints={
            "type": "ineq",
            "fun": lambda z: nearby(z[:n]) - z[n],
            "jac": lambda z: np.hstack([nearby.slopes(z[:n]), -np.ones((len(nearby.base), 1))]),
        },
        method="SLSQP",
        options={"maxiter": 40, "ftol": 1e-9},
    )
    return np.clip(found.x[:n], low, high)


#: the paper's converter with u one sample late, on which a law with an inner stage is judged
LATE = Plant.model_validate({"delay": {"samples": 1}})

#: Section IV-A's initial K, by law: what ``tune`` starts from if not told otherwise
PAPER_START: dict[str, dict[str, float]] = {
    "mimo-gfm": {
        "k_pdc": 90.0,
        "k_idc": 400.0,
        **dict.fromkeys(("k_12", "k_14", "k_15", "k_21", "k_24", "k_31", "k_32"), 0.0),
        "k_22": 20.0,
        "k_34": 1.0,
    }
}


@dataclass
class PaperProblem:
    """gamma of a law on the paper's converter, as a function of its free gains.

    The plant is ideal whatever ``plant`` says of delay and sensors; factors and the DC source
    count. With an inner stage u acts one sample late. The operating point is that of the starting
    gains. ``late`` is the loop there sampled at T_s with one sample of delay, for other laws to be
    put into it; a sampled loop as it is.

    With a ``decay`` a > 0 [1/s] the cost is the norm of W_ij(s) T_ij(s - a) in place of
    W_ij(s) T_ij(s), which is finite if every mode of the loop decays faster than a.

    ``among`` gives the loop of a law where else it is to be judged, sampled; as that of
    ``NetworkLoop.converter``. Plant, references and T_s are then those of that loop.
    ``others`` are more such loops: gamma is the largest of all, and every loop must be stable.
    """

    file: LawFile
    gains: tuple[FreeGain, ...]
    plant: Plant = field(default_factory=Plant)
    references: tuple[float, ...] = REFERENCES
    weights: tuple[Weight, ...] = PAPER_WEIGHTS
    T_s: float = T_S
    among: Callable[[BuiltLaw], ClosedLoop] | None = None
    decay: float = 0.0
    others: tuple[Callable[[BuiltLaw], ClosedLoop], ...] = ()

    def __post_init__(self) -> None:
        judged = LATE if self.file.inner is not None else Plant()
        update = {"sensors": judged.sensors, "delay": judged.delay}
        self._judged = self.plant.model_copy(update=update)
        self._screen = Screen(self.weights)
        self._others = [replace(self, among=one, others=()) for one in self.others]
        self.move_to({g.name: g.start for g in self.gains})

    def move_to(self, named: dict[str, float]) -> None:
        """Take the operating point of these gains (it hardly depends on them)."""
        law, ref = build_law(self.file, named), np.asarray(self.references)
        controlled = self.plant.dc_source.mode == "controlled"
        if self.among is None:
            ideal = not self.is_sampled
            self._nominal = ClosedLoop.of(law, self._judged, ref, T_s=self.T_s, ideal=ideal)
        else:
            self._nominal = self.among(law)
            assert self._nominal.T_s is not None
            self.T_s, ref = self._nominal.T_s, self._nominal.ref
            controlled = self._nominal.dc_control
        self.late = self._nominal if self.is_sampled else self._nominal.sampled(self.T_s, self.T_s)
        self.law = GainedLaw(self.file, self.gains, self.op, ref, controlled)
        for other in self._others:
            other.move_to(named)

    @property
    def is_sampled(self) -> bool:
        """Whether the sampled loop is judged: with an inner stage, and in a network."""
        return self.file.inner is not None or self.among is not None

    @property
    def op(self) -> OperatingPoint:
        """The operating point of plant and law."""
        return self._nominal.op

    @property
    def linear(self) -> LinearPlant:
        """The plant around its operating point."""
        return self._nominal.plant

    def loops(self, values: Vector) -> StateSpace:
        """T(s) at these gains; rows of gains give stacked loops, nan where they make no law."""
        loops = self._shifted(self.closed_loops(values).performance())
        return inverse_tustin(*loops, self.T_s / 2) if self.is_sampled else loops

    def _shifted(self, loops: StateSpace) -> StateSpace:
        """T(s - decay) of T(s), in continuous time or from tick to tick."""
        A, B, C, D = loops
        if self.is_sampled:
            faster = np.exp(self.decay * self.T_s)
            return faster * A, faster * B, C, D
        return A + self.decay * np.eye(A.shape[-1]), B, C, D

    def closed_loop(self, values: Vector) -> ClosedLoop:
        """The loop at these gains, with as few states as the law needs.

        Raises:
            LawError: the gains make no law.
        """
        return self._nominal.with_law(self._runs(self.law.exact(values)))

    def closed_loops(self, values: Vector) -> ClosedLoop:
        """The loops at rows of gains, in one; nan where they make no law."""
        return self._nominal.with_law(self._runs(self.law(values)))

    def _runs(self, law: LinearLaw) -> LinearLaw:
        """The law as the loop has it, continuous or from tick to tick."""
        return law.sampled(self.T_s) if self.is_sampled else law

    def __call__(self, values: Vector) -> float:
        """Cost: a close lower bound of gamma, or what an unstable loop costs."""
        return float(self.many(values[None, :])[0])

    def many(self, values: Vector) -> Vector:
        """Costs of several sets of gains, one a row."""
        return np.max([one.own(values) for one in self._each], axis=0)

    def own(self, values: Vector) -> Vector:
        """``many`` without the other loops."""
        costs = np.full(len(values), 1.99 * UNSTABLE)
        A, B, C, D = self.loops(values)
        good = np.flatnonzero(np.all([np.isfinite(m).all(axis=(1, 2)) for m in (A, B, C, D)], 0))
        if len(good):
            gammas, abscissae = self._screen((A[good], B[good], C[good], D[good]))
            costs[good] = np.where(np.isfinite(gammas), gammas, unstable_cost(abscissae))
        return costs

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """A lower gamma nearby, by the active peaks of the loop in which it is largest."""
        worst = max(self._each, key=lambda one: one.own(code.values(point)[None])[0])
        try:
            found = polish(
                lambda x: worst.loops(code.values(x)), self.weights, point, code.low, code.high
            )
        except np.linalg.LinAlgError:
            return point
        lower = not self.others or self(code.values(found)) < self(code.values(point))
        return found if lower else point

    @property
    def _each(self) -> list[PaperProblem]:
        """The problems of the loop and of the others."""
        return [self, *self._others]

    def channels(self, values: Vector) -> tuple[WeightedChannel, ...]:
        """Every channel's norm, guaranteed, with the decay if there is one, in the loop in which it
        is largest. Raises ``Unstable``."""
        return worst_channels(
            channel_norms(self._shifted(loop.performance()), self.weights, loop.T_s)
            for loop in self.all_loops(values)
        )

    def all_loops(self, values: Vector) -> list[ClosedLoop]:
        """``closed_loop`` in each loop, the others included."""
        return [one.closed_loop(values) for one in self._each]


def worst_channels(each: Iterable[tuple[WeightedChannel, ...]]) -> tuple[WeightedChannel, ...]:
    """Of several loops with the same weights, each channel in the loop in which it is largest."""
    return tuple(max(same, key=lambda c: c.norm) for same in zip(*each, strict=True))


EVALUATIONS = 240  # of each start, before its polish
_STARTS = 6  # and one more for every gain
_SAME = 1e-6  # relative: heights this close count as equal, and as independent of a gain
_SETTLES = 3  # most polishes, each at the operating point of the previous result


def starts_for(gains: int) -> int:
    """Number of starts for a law with this number of free gains."""
    return _STARTS + gains


def tune_paper(
    problem: PaperProblem,
    seed: int = 0,
    evaluations: int = EVALUATIONS,
    starts: int | None = None,
    progress: Callable[[int, float], None] = lambda done, best: None,
) -> Tuned:
    """Choose the gains of ``problem``: a seed always gives the same gains, never worse than the
    starting ones.

    If no gain changes the highest channel (for example W_41 T_41(0) of a law with another droop
    than the problem's), gamma does not distinguish good gains from bad ones. The search then
    minimises the largest of the channels that the gains change.

    The search uses the operating point of the starting gains. If the found gains have another one,
    the last steps are repeated there, and ``problem`` is moved there. ``cost`` is gamma with the
    guarantee of ``norms.hinf`` at that point.

    Args:
        problem: law, free gains with starts and bounds, weights.
        seed: of the search.
        evaluations: of each start, once it is stable.
        starts: the given one and random ones; by default more for a law with more gains.
        progress: called with the evaluations done and the best gamma so far.

    Raises:
        NotStabilised: no stable loop was found.
    """
    begin = time.perf_counter()
    starts = starts or starts_for(len(problem.gains))
    found = _settled(problem, tune(problem, problem.gains, seed, evaluations, starts, progress))
    fixed = _fixed(problem, found.values)
    moved = tuple(w for w in problem.weights if w not in fixed)
    if fixed and moved:
        told, gamma = found.evaluations, found.cost
        rest = replace(problem, weights=moved)
        again = tune_paper(
            rest, seed, evaluations, starts, lambda done, best: progress(told + done, gamma)
        )
        found = replace(found, evaluations=told + again.evaluations)
        cost = _gamma(problem, again.values)
        if cost <= (1.0 + _SAME) * gamma:
            found = replace(found, values=again.values, cost=cost)
        problem.move_to(problem.law.named(found.values))
    return replace(found, seconds=time.perf_counter() - begin)


def _settled(problem: PaperProblem, found: Tuned) -> Tuned:
    """The best of the start, of ``found``, and of its polish at its own operating point."""
    code = Encoding(problem.gains)
    candidates, at = [code.values(code.start), found.values], found.values
    for _ in range(_SETTLES):
        before = problem.op.x
        problem.move_to(problem.law.named(at))
        if np.allclose(problem.op.x, before, rtol=0.0, atol=1e-9):
            break
        at = code.values(problem.polish(code, code.coordinates(at)))
        candidates.append(at)
    gammas = [_gamma(problem, values) for values in candidates]
    values = candidates[int(np.argmin(gammas))]
    if not np.isfinite(min(gammas)):
        raise NotStabilised(values, found.evaluations, problem(values))
    problem.move_to(problem.law.named(values))
    return replace(found, values=values, cost=min(gammas))


def _fixed(problem: PaperProblem, values: Vector) -> set[Weight]:
    """The highest channels, if no gain changes them."""
    code = Encoding(problem.gains)
    at = code.coordinates(values)

    def loops(x: Vector) -> StateSpace:
        return problem.loops(code.values(x))

    found = peaks(loops(at), problem.weights)
    if found is None:
        return set()
    nearby = model(loops, problem.weights, at, found)
    still = np.abs(nearby.slope).max(axis=1) < _SAME * nearby.base
    highest = found.height > (1.0 - _SAME) * found.height[0]
    # if a gain can lower one of the highest channels, gamma is the right cost
    return {problem.weights[c] for c in found.channel[highest & still]} if still[0] else set()


def _gamma(problem: PaperProblem, values: Vector) -> float:
    """gamma at the operating point of these gains; inf if there is none."""
    try:
        problem.move_to(problem.law.named(values))
        return max(c.norm for c in problem.channels(values))
    except (Unstable, NoEquilibrium):
        return np.inf
