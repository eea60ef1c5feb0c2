"""A law on a plant, as a scenario describes it: its sampled loop at any elements of the circuit."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import linearise_law, linearise_plant
from gfm_design.model.operating_point import operating_point
from gfm_design.model.sampled import SampledLoop
from gfm_plant import Plant, load_converter, make_plant
from gfm_plant.parameters import Element
from gfm_plant.records import PlantRecord
from gfm_runtime.tustin import DiscreteLaw


class Case:
    """A law at its sampling time on a plant with its imperfections.

    Args:
        plant: delay, sensors, DC source, grid and factors of its elements.
        law: the law at its sampling time.
        ref: references (V_dcref, P_ref, omega_g, Q_ref, V_ref), shape (5,), p.u.
    """

    def __init__(self, plant: Plant, law: DiscreteLaw, ref: NDArray[np.float64]) -> None:
        self.plant, self.law, self.ref = plant, law, ref
        self._nominal = load_converter(plant.converter).pu()

    @cached_property
    def _par(self) -> PlantRecord:
        return make_plant(self.plant, self.law.T_s)[0]

    def factor(self, element: Element) -> float:
        """Real over nominal value of an element."""
        return self.plant.factors.get(element, 1.0)

    def line(self, L_g: float, R_g: float) -> complex:
        """Z_g in p.u. at these factors of the line's elements."""
        return complex(self._nominal["R_g"] * R_g, self._nominal["L_g"] * L_g)

    def loop(self, factors: Mapping[Element, float] | None = None) -> SampledLoop:
        """The loop at its operating point; ``factors`` replace the plant's own.

        Raises:
            NoEquilibrium: plant and law have none there.
        """
        # into the record: the emulator's sub-step, which make_plant checks, plays no part here
        par = self._par.copy()
        for name, factor in (factors or {}).items():
            par[name] = self._nominal[name] * factor
        grid, delay = self.plant.grid, self.plant.delay
        op = operating_point(par, self.law, self.ref, grid.omega_g, grid.V_g)
        linear = linearise_plant(par, op, grid.omega_g, grid.V_g)
        dc_control = self.plant.dc_source.mode == "controlled"
        law = linearise_law(self.law.law, self.law, op, self.ref, dc_control)
        seconds = (delay.samples + delay.fraction) * self.law.T_s
        return SampledLoop(linear, law, self.law.T_s, seconds)
