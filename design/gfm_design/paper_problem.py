"""The paper's synthesis problem as a cost: gamma of the ideal continuous loop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gfm_design.gains import FreeGain, GainedLaw
from gfm_design.linear import linearise_plant
from gfm_design.operating_point import operating_point
from gfm_design.performance import (
    PAPER_WEIGHTS,
    Channel,
    StateSpace,
    Weight,
    channel_norms,
    performance_loop,
)
from gfm_design.screen import Screen
from gfm_design.synthesis import UNSTABLE, unstable_cost
from gfm_plant import Plant, make_plant
from gfm_runtime.discretise import discretise
from gfm_runtime.errors import LawError
from gfm_runtime.lawfile import LawFile, build_law

Vector = NDArray[np.float64]

REFERENCES = (1.0, 0.5, 1.0, 0.0, 1.0)  # Table III


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
        self.law = GainedLaw(self.file, self.gains, op, ref, dc_control)

    def loop(self, values: Vector) -> StateSpace:
        """T(s) at these gains."""
        return performance_loop(self._linear, self.law(values))

    def __call__(self, values: Vector) -> float:
        """Cost: gamma to a few 1e-4, or what an unstable loop costs."""
        try:
            gamma, abscissa = self._screen(self.loop(values))
        except (LawError, np.linalg.LinAlgError):
            return 2 * UNSTABLE
        return gamma if np.isfinite(gamma) else unstable_cost(abscissa)

    def channels(self, values: Vector) -> tuple[Channel, ...]:
        """Every channel's norm, guaranteed. Raises ``Unstable``."""
        return channel_norms(self.loop(values), self.weights)
