"""The paper's synthesis problem as a cost: gamma of the ideal continuous loop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearPlant, hold, linearise_law, linearise_plant
from gfm_design.model.operating_point import OperatingPoint, operating_point
from gfm_design.norms.performance import (
    PAPER_WEIGHTS,
    Channel,
    StateSpace,
    Weight,
    channel_norms,
    performance_loop,
)
from gfm_design.norms.screen import Screen
from gfm_design.tuning.gains import Encoding, FreeGain, GainedLaw
from gfm_design.tuning.polish import polish
from gfm_design.tuning.synthesis import UNSTABLE, unstable_cost
from gfm_plant import Plant, make_plant
from gfm_runtime.lawfile import LawFile, build_law
from gfm_runtime.signals import NU
from gfm_runtime.tustin import discretise

Vector = NDArray[np.float64]

REFERENCES = (1.0, 0.5, 1.0, 0.0, 1.0)  # Table III

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
    count. The operating point is that of the starting gains.
    """

    file: LawFile
    gains: tuple[FreeGain, ...]
    plant: Plant = field(default_factory=Plant)
    references: tuple[float, ...] = REFERENCES
    weights: tuple[Weight, ...] = PAPER_WEIGHTS
    T_s: float = 1e-4

    def __post_init__(self) -> None:
        ideal = self.plant.model_copy(update={"sensors": Plant().sensors})
        self._par, _ = make_plant(ideal, self.T_s)
        self._screen = Screen(self.weights)
        self.move_to({g.name: g.start for g in self.gains})

    def move_to(self, named: dict[str, float]) -> None:
        """Take the operating point of these gains (it hardly depends on them)."""
        ref = np.asarray(self.references)
        law = discretise(build_law(self.file, named), self.T_s)
        op = operating_point(self._par, law, ref, self.plant.grid.omega_g, self.plant.grid.V_g)
        self._linear = linearise_plant(self._par, op, self.plant.grid.omega_g, self.plant.grid.V_g)
        dc_control = self.plant.dc_source.mode == "controlled"
        self._rest = op, ref, dc_control
        self.law = GainedLaw(self.file, self.gains, *self._rest)
        self._slopes = self._affine_loop() if self.gains and self.law.is_affine else None

    def _affine_loop(self) -> list[tuple[Vector, Vector]]:
        """T(s)'s matrices at gains of zero, and what each gain adds: they are affine too."""
        base = performance_loop(self._linear, self.law(np.zeros(len(self.gains))))
        ones = performance_loop(self._linear, self.law(np.eye(len(self.gains))))
        return [(m, one - m) for m, one in zip(base, ones, strict=True)]

    @property
    def op(self) -> OperatingPoint:
        """Where plant and law rest."""
        return self._rest[0]

    @property
    def linear(self) -> LinearPlant:
        """The plant around its operating point."""
        return self._linear

    def loops(self, values: Vector) -> StateSpace:
        """T(s) at these gains; rows of gains give stacked loops, nan where they make no law."""
        if self._slopes is None:
            return performance_loop(self._linear, self.law(values))
        A, B, C, D = (m + np.tensordot(values, s, 1) for m, s in self._slopes)
        return A, B, C, D

    def loop(self, values: Vector) -> StateSpace:
        """T(s) at these gains, with as few states as the law needs.

        Raises:
            LawError: the gains make no law.
        """
        return performance_loop(self._linear, self.law.exact(values))

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

    def channels(self, values: Vector) -> tuple[Channel, ...]:
        """Every channel's norm, guaranteed. Raises ``Unstable``."""
        return channel_norms(self.loop(values), self.weights)

    def sampled_channels(self, values: Vector) -> tuple[Channel, ...]:
        """As ``channels`` of the loop at T_s: law by Tustin, u and w held over each tick, no delay.

        Raises:
            Unstable: the sampled loop is not stable.
        """
        file_law = build_law(self.file, self.law.named(values))
        law = discretise(file_law, self.T_s)
        reaction = linearise_law(file_law, law, *self._rest)
        plant, inputs = self._linear, np.hstack([self._linear.B, self._linear.B_d])
        A, B = hold(plant.A, inputs, self.T_s)
        sampled = LinearPlant(A, B[:, :NU], B[:, NU:], plant.C)
        return channel_norms(performance_loop(sampled, reaction), self.weights, self.T_s)
