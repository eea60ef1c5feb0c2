"""The paper's synthesis problem as a cost: gamma of the ideal continuous loop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import REFERENCES, T_S, ClosedLoop
from gfm_design.model.linear import LinearPlant
from gfm_design.model.operating_point import OperatingPoint
from gfm_design.norms.performance import PAPER_WEIGHTS, Channel, StateSpace, Weight
from gfm_design.norms.screen import Screen
from gfm_design.tuning.gains import Encoding, FreeGain, GainedLaw
from gfm_design.tuning.polish import polish
from gfm_design.tuning.synthesis import UNSTABLE, unstable_cost
from gfm_plant import Plant
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

#: Section IV-A's initial K, by law: the default start of ``tune``
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

    The problem uses the factors and the DC source of ``plant``, but neither its delay nor its
    sensors. The operating point is that of the starting gains. ``late`` is the loop there, sampled
    at T_s with one sample of delay; callers put other laws into it.
    """

    file: LawFile
    gains: tuple[FreeGain, ...]
    plant: Plant = field(default_factory=Plant)
    references: tuple[float, ...] = REFERENCES
    weights: tuple[Weight, ...] = PAPER_WEIGHTS
    T_s: float = T_S

    def __post_init__(self) -> None:
        self._ideal = self.plant.model_copy(update={"sensors": Plant().sensors})
        self._screen = Screen(self.weights)
        self.move_to({g.name: g.start for g in self.gains})

    def move_to(self, named: dict[str, float]) -> None:
        """Move to the operating point of these gains; it hardly depends on them."""
        law, ref = build_law(self.file, named), np.asarray(self.references)
        self._rest = ClosedLoop.of(law, self._ideal, ref, T_s=self.T_s, ideal=True)
        self.late = self._rest.sampled(self.T_s, self.T_s)
        controlled = self.plant.dc_source.mode == "controlled"
        self.law = GainedLaw(self.file, self.gains, self.op, ref, controlled)

    @property
    def op(self) -> OperatingPoint:
        """The common operating point of plant and law."""
        return self._rest.made_of.op

    @property
    def linear(self) -> LinearPlant:
        """The plant around its operating point."""
        return self._rest.plant

    def loops(self, values: Vector) -> StateSpace:
        """T(s) at these gains; rows of gains give stacked loops, nan where they give no law."""
        return self.closed_loops(values).performance()

    def closed_loop(self, values: Vector) -> ClosedLoop:
        """The continuous loop at these gains, with as few states as the law needs.

        Raises:
            LawError: the gains give no valid law.
        """
        return self._rest.with_law(self.law.exact(values))

    def closed_loops(self, values: Vector) -> ClosedLoop:
        """The continuous loops at rows of gains, stacked; nan where they give no law."""
        return self._rest.with_law(self.law(values))

    def __call__(self, values: Vector) -> float:
        """Cost: a close lower bound of gamma, or the cost of an unstable loop."""
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
        """A point nearby with a lower gamma, found from the active peaks."""
        try:
            return polish(
                lambda x: self.loops(code.values(x)), self.weights, point, code.low, code.high
            )
        except np.linalg.LinAlgError:
            return point

    def channels(self, values: Vector) -> tuple[Channel, ...]:
        """Every channel's norm, guaranteed. Raises ``Unstable``."""
        return self.closed_loop(values).channels(self.weights)

    def sampled_channels(self, values: Vector) -> tuple[Channel, ...]:
        """As ``channels``, of the loop sampled at T_s: law by Tustin, u and w held, no delay.

        Raises:
            Unstable: the sampled loop is not stable.
        """
        return self.closed_loop(values).sampled(self.T_s).channels(self.weights)
