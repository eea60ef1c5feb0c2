"""The converter is as stiff as a voltage source behind an impedance, by its P/θ and Q/V."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from gfm_hil.studies.conformity.criteria.plot import Plot, PlotPanel
from gfm_hil.studies.conformity.verdict import CANNOT, FAIL, PASS, Outcome, Verdict
from gfm_hil.studies.scan import FrequencyScan


class Stiffness(Plot):
    """The least sizes of P/θ and Q/V over a band of frequencies, measured by small sines: the
    change of p over that of the angle of the voltage at the point of connection, and of q over that
    of its magnitude. Behind a stiff voltage and a reactance X both are about 1/X. A part with this
    criterion has no other one, and no events count."""

    kind: Literal["stiffness"] = Field(description="kind of criterion")
    least_P: float | None = Field(None, gt=0, description="limit of |P/θ|, p.u./rad")
    least_Q: float | None = Field(None, gt=0, description="limit of |Q/V|, p.u./p.u.")
    unknown: str | None = Field(
        None, description="why a limit is not known; what has none is measured and cannot be judged"
    )

    @model_validator(mode="after")
    def _judged_or_not(self) -> Stiffness:
        if (None in (self.least_P, self.least_Q)) != (self.unknown is not None):
            raise ValueError("least_P, least_Q, unknown: give both limits, or why one is missing")
        return self

    def judge_scan(self, found: FrequencyScan) -> list[Verdict]:
        low, high = (float(found.frequency[k]) for k in (0, -1))
        where, verdicts = f"from {low:.3g} to {high:.3g} Hz", []
        for curve, least in zip(self.curves(found), (self.least_P, self.least_Q), strict=True):
            k = int(np.argmin(curve.measured))
            value, name = float(curve.measured[k]), curve.title.partition(" ")[0]
            text = f"The least {name} {where} is {value:.4g} {curve.unit}, at "
            text += f"{found.frequency[k]:.3g} Hz."
            outcome: Outcome = CANNOT
            limit = "" if least is None else f"at least {least:g} {curve.unit}, {where}"
            if least is None:
                text = f"Cannot be judged: {self.unknown}. {text}"
            else:
                outcome = PASS if value >= least else FAIL
            over = low, high
            verdicts.append(self._made(outcome, value, curve.unit, limit, text, least, None, over))
        return verdicts

    def curves(self, found: FrequencyScan) -> list[PlotPanel]:
        measured = found.stiffness(found.Y)
        model = (None, None) if found.model is None else found.stiffness(found.model)
        return [
            PlotPanel(f"{name} [{unit}]", unit, np.abs(x), None if y is None else np.abs(y), True)
            for name, unit, x, y in zip(
                ("|P/θ|", "|Q/V|"), ("p.u./rad", "p.u./p.u."), measured, model, strict=True
            )
        ]


CRITERION = Stiffness
