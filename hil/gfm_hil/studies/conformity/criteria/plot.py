"""What the criteria of a measured plot share: they judge a frequency scan in place of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gfm_hil.scenario import Scenario
from gfm_hil.studies.conformity.criteria.base import Clause
from gfm_hil.studies.conformity.verdict import Verdict
from gfm_hil.studies.scan import FrequencyScan, measure_admittance

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class PlotPanel:
    """A panel of a plot: measured, and by the linear model if there is one, shape (K,) each."""

    title: str
    unit: str
    measured: Vector
    model: Vector | None
    log: bool  # whether its axis is logarithmic


class Plot(Clause):
    """A plot over frequency, measured by small sines of the grid. A part with such a criterion has
    no other one, and no events count."""

    alone: ClassVar[str] = "a plot is the frequency scan of a converter alone"

    from_hz: float = Field(1.0, ge=0.01, description="lowest frequency of the plot, Hz")
    to_hz: float = Field(100.0, gt=0, description="highest frequency of the plot, Hz")
    points: int = Field(21, ge=2, le=1000, description="evenly apart on a logarithmic axis")

    @model_validator(mode="after")
    def _has_an_axis(self) -> Plot:
        if self.at is not None:
            raise ValueError("at: a plot has no time")
        if not self.from_hz < self.to_hz:
            raise ValueError(f"from_hz = {self.from_hz:g}: must be < to_hz = {self.to_hz:g}")
        return self

    def scan(self, scenario: Scenario, controller_command: Sequence[str]) -> FrequencyScan:
        """Measure the plot. Raises UserError: as ``measure_admittance``."""
        return measure_admittance(
            scenario, start_hz=self.from_hz, stop_hz=self.to_hz, points=self.points,
            controller_command=controller_command,
        )  # fmt: skip

    def again(self, scenario: str) -> list[str]:
        """The command that measures the plot of a scenario file again."""
        return [
            "gfmhil", "scan", scenario, "--from", f"{self.from_hz:g}", "--to", f"{self.to_hz:g}",
            "--points", str(self.points),
        ]  # fmt: skip

    def judge_scan(self, found: FrequencyScan) -> list[Verdict]:
        """The verdicts on a plot."""
        raise NotImplementedError

    def curves(self, found: FrequencyScan) -> list[PlotPanel]:
        """The panels of its figure."""
        raise NotImplementedError

    def _made(self, *rest: Any) -> Verdict:
        return self.with_source(Verdict(self.clause, self.kind, "p", 0.0, 0.0, *rest))
