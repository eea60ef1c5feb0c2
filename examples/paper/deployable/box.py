"""The box of real loops that deployable gains must stabilise: its points and corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.closed_loop import T_S, ClosedLoop
from gfm_plant import Plant
from gfm_runtime.tustin import DiscreteLaw

Matrix = NDArray[np.float64]

Source = Literal["controlled", "regulated"]
SOURCES: tuple[Source, ...] = get_args(Source)

SENSORS_HZ = 300.0


@dataclass(frozen=True)
class Point:
    """One loop of the box: a converter with its line, the loop delay and the power reference.

    Attributes:
        R_f, R_g, L_g: real over nominal value of the elements.
        delay: from the sample to its effect, in sampling periods.
        P_ref: p.u.
        dc: the DC source, as the paper's simulation (controlled) or its rig (regulated).
    """

    R_f: float = 1.0
    R_g: float = 1.0
    L_g: float = 1.0
    delay: float = 1.0
    P_ref: float = 0.5
    dc: Source = "controlled"

    def plant(self) -> Plant:
        """Options of this plant, its sensors included."""
        samples = int(self.delay)
        return Plant.model_validate(
            {
                "factors": {"R_f": self.R_f, "R_g": self.R_g, "L_g": self.L_g},
                "delay": {"samples": samples, "fraction": self.delay - samples},
                "sensors": {"bandwidth_hz": SENSORS_HZ},
                "dc_source": {"mode": self.dc},
            }
        )

    def loop(self, law: str | DiscreteLaw) -> ClosedLoop:
        """The sampled loop of a law here.

        Raises:
            NoEquilibrium: there is no operating point.
        """
        # a plant's delay has a limit, that of a loop has none
        prompt = ClosedLoop.of(law, replace(self, delay=0.0).plant(), self.references())
        return prompt.later(self.delay * T_S)

    def references(self) -> Matrix:
        """(V_dcref, P_ref, omega_g, Q_ref, V_ref), p.u."""
        return np.array([1.0, self.P_ref, 1.0, 0.0, 1.0])

    def __str__(self) -> str:
        return (
            f"R_f x {self.R_f:.3g}, R_g x {self.R_g:.3g}, L_g x {self.L_g:.3g}, "
            f"{self.delay * T_S * 1e6:.0f} us, P_ref = {self.P_ref:.3g}, {self.dc}"
        )


@dataclass(frozen=True)
class Box:
    """The values that the corners combine; the extremes bound the box."""

    R_f: tuple[float, ...] = (0.1, 1.0, 3.0)
    R_g: tuple[float, ...] = (0.1, 1.0, 3.0)
    L_g: tuple[float, ...] = (0.8, 3.0, 10.0, 20.0)
    delay: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    P_ref: tuple[float, ...] = (0.0, 0.5, 1.0)
    dc: tuple[Source, ...] = SOURCES

    def corners(self) -> list[Point]:
        """Every combination."""
        return [
            Point(*values)
            for values in product(self.R_f, self.R_g, self.L_g, self.delay, self.P_ref, self.dc)
        ]

    def random(self, count: int, seed: int) -> list[Point]:
        """Points inside: factors by their logarithm, delay and P_ref evenly, either DC source."""
        rng = np.random.default_rng(seed)

        def factor(values: tuple[float, ...]) -> float:
            return float(np.exp(rng.uniform(np.log(min(values)), np.log(max(values)))))

        return [
            Point(
                factor(self.R_f),
                factor(self.R_g),
                factor(self.L_g),
                float(rng.uniform(min(self.delay), max(self.delay))),
                float(rng.uniform(min(self.P_ref), max(self.P_ref))),
                self.dc[int(rng.integers(len(self.dc)))],
            )
            for _ in range(count)
        ]
