"""The paper's synthesis problem as a cost: gamma of the ideal continuous loop.

A law with an inner stage has no continuous loop, since the stage runs from tick to tick. Its gamma
is that of the sampled loop with u one sample late and the weights by Tustin. On a scenario, and so
in a network, it is that of the sampled loop with the delays and sensors there. The searches work on
the inverse Tustin transform of such a loop, which has the same norms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import REFERENCES, T_S, ClosedLoop
from gfm_design.model.linear import LinearLaw, LinearPlant, inverse_tustin
from gfm_design.model.operating_point import OperatingPoint
from gfm_design.norms.performance import (
    PAPER_WEIGHTS,
    StateSpace,
    Weight,
    WeightedChannel,
    channel_norms,
)
from gfm_design.norms.screen import Screen
from gfm_design.tuning.gains import Encoding, FreeGain, GainedLaw
from gfm_design.tuning.polish import polish
from gfm_design.tuning.synthesis import UNSTABLE, unstable_cost
from gfm_plant import Plant
from gfm_runtime.law import Law
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

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
    """

    file: LawFile
    gains: tuple[FreeGain, ...]
    plant: Plant = field(default_factory=Plant)
    references: tuple[float, ...] = REFERENCES
    weights: tuple[Weight, ...] = PAPER_WEIGHTS
    T_s: float = T_S
    among: Callable[[Law], ClosedLoop] | None = None
    decay: float = 0.0

    def __post_init__(self) -> None:
        judged = LATE if self.has_stage else Plant()
        update = {"sensors": judged.sensors, "delay": judged.delay}
        self._judged = self.plant.model_copy(update=update)
        self._screen = Screen(self.weights)
        self.move_to({g.name: g.start for g in self.gains})

    def move_to(self, named: dict[str, float]) -> None:
        """Take the operating point of these gains (it hardly depends on them)."""
        law, ref = build_law(self.file, named), np.asarray(self.references)
        controlled = self.plant.dc_source.mode == "controlled"
        if self.among is None:
            ideal = not self.is_sampled
            self._rest = ClosedLoop.of(law, self._judged, ref, T_s=self.T_s, ideal=ideal)
        else:
            self._rest = self.among(law)
            assert self._rest.T_s is not None
            self.T_s, ref = self._rest.T_s, self._rest.ref
            controlled = self._rest.dc_control
        self.late = self._rest if self.is_sampled else self._rest.sampled(self.T_s, self.T_s)
        self.law = GainedLaw(self.file, self.gains, self.op, ref, controlled)

    @property
    def has_stage(self) -> bool:
        """Whether the law has an inner stage."""
        return self.file.inner is not None

    @property
    def is_sampled(self) -> bool:
        """Whether the sampled loop is judged: with an inner stage, and in a network."""
        return self.has_stage or self.among is not None

    @property
    def op(self) -> OperatingPoint:
        """Where plant and law rest."""
        return self._rest.op

    @property
    def linear(self) -> LinearPlant:
        """The plant around its operating point."""
        return self._rest.plant

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
        return self._rest.with_law(self._runs(self.law.exact(values)))

    def closed_loops(self, values: Vector) -> ClosedLoop:
        """The loops at rows of gains, in one; nan where they make no law."""
        return self._rest.with_law(self._runs(self.law(values)))

    def _runs(self, law: LinearLaw) -> LinearLaw:
        """The law as the loop has it, continuous or from tick to tick."""
        return law.sampled(self.T_s) if self.is_sampled else law

    def __call__(self, values: Vector) -> float:
        """Cost: a close lower bound of gamma, or what an unstable loop costs."""
        return float(self.many(values[None, :])[0])

    def many(self, values: Vector) -> Vector:
        """Costs of several sets of gains, one a row."""
        costs = np.full(len(values), 1.99 * UNSTABLE)
        A, B, C, D = self.loops(values)
        good = np.flatnonzero(np.all([np.isfinite(m).all(axis=(1, 2)) for m in (A, B, C, D)], 0))
        if len(good):
            gammas, abscissae = self._screen((A[good], B[good], C[good], D[good]))
            costs[good] = np.where(np.isfinite(gammas), gammas, unstable_cost(abscissae))
        return costs

    def polish(self, code: Encoding, point: Vector) -> Vector:
        """A lower gamma nearby, by its active peaks."""
        try:
            return polish(
                lambda x: self.loops(code.values(x)), self.weights, point, code.low, code.high
            )
        except np.linalg.LinAlgError:
            return point

    def channels(self, values: Vector) -> tuple[WeightedChannel, ...]:
        """Every channel's norm, guaranteed, with the decay if there is one. Raises ``Unstable``."""
        loop = self.closed_loop(values)
        return channel_norms(self._shifted(loop.performance()), self.weights, loop.T_s)
