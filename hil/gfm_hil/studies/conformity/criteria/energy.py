"""A change of frequency takes enough energy out of the converter."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict


class Energy(Windowed):
    """The inertia constant that the energy given in a change of frequency shows,
    H = f_n dE / (2 abs(df)) with dE the integral of p beyond what it was before."""

    kind: Literal["energy"] = Field(description="kind of criterion")
    df_hz: float = Field(description="change of the grid's frequency in the window, Hz")
    least_s: float = Field(gt=0, description="least inertia constant, s")

    def judge(self, m: Moment) -> Verdict:
        """The value is the inertia constant, s."""
        p = m.raw("p")[m.first : m.last]
        dE = float(np.sum(p - m.before("p"))) * m.T_s
        H = -math.copysign(1.0, self.df_hz) * m.f_n * dE / (2 * abs(self.df_hz))
        text = (
            f"In the window p gives {dE:.3g} p.u. s more than before, as an inertia constant of "
            f"{H:.3g} s would; at least {self.least_s:g} s are asked."
        )
        return m.says(self.least_s <= H, H, "s", f"at least {self.least_s:g} s", text, "p")


CRITERION = Energy
