"""The balance of the grid's phases."""

from __future__ import annotations

import cmath
import math
from typing import Literal

from pydantic import Field, model_validator

import gfm_plant
from gfm_hil.scenario.events.base import GridEvent


class GridUnbalance(GridEvent):
    """The grid's phases a, b, c keep a part of their voltage and jump in angle."""

    type: Literal["grid-unbalance"] = Field(description="kind of event")
    retained: tuple[float, float, float] = Field(
        (1.0, 1.0, 1.0), strict=False, description="voltages of a, b, c over what they were"
    )
    degrees: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), strict=False, description="by which a, b, c jump ahead"
    )
    duration: float | None = Field(
        None, gt=0, description="s until they are equal again; none: until another such event"
    )

    @model_validator(mode="after")
    def _in_bounds(self) -> GridUnbalance:
        for name, values, limit in (
            ("retained", self.retained, 1.5),
            ("degrees", self.degrees, 180),
        ):
            low = 0.0 if name == "retained" else -180.0
            if not all(low <= value <= limit for value in values):
                raise ValueError(f"{name} = {list(values)}: must lie in [{low:g}, {limit:g}]")
        return self

    def factors(self) -> tuple[complex, ...]:
        """Of the phase voltages."""
        return tuple(
            size * cmath.exp(1j * math.radians(angle))
            for size, angle in zip(self.retained, self.degrees, strict=True)
        )

    def label(self) -> str:
        sizes = ", ".join(f"{size:g}" for size in self.retained)
        turns = ", ".join(f"{angle:g}°" for angle in self.degrees) if any(self.degrees) else ""
        return f"phases at {sizes}" + (f", turned {turns}" if turns else "")

    def apply(self, plant: gfm_plant.Network) -> None:
        gfm_plant.grid_unbalance(plant, self.factors(), self.duration)
