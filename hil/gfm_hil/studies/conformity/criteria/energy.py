"""A change of frequency takes enough energy out of the converter."""

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import FAIL, PASS, Outcome, Verdict


class Energy(Windowed):
    """The inertia constant that the energy given in a change of frequency shows,
    H = f_n dE / (2 abs(df)) with dE the integral of p beyond what it was before, and beyond what
    the declared droop gives at the frequency that the converter has."""

    kind: Literal["energy"] = Field(description="kind of criterion")
    df_hz: float = Field(description="change of the grid's frequency in the window, Hz")
    least_s: float = Field(gt=0, description="least inertia constant, s")
    net_of_droop: bool = Field(
        True, description="false: what the droop gives counts as inertia does"
    )

    coarse: ClassVar[tuple[Outcome, ...]] = (PASS, FAIL)

    def judge(self, m: Moment) -> Verdict:
        """The value is the inertia constant, s."""
        p = m.raw("p")[m.first : m.last]
        dE = float(np.sum(p - m.before("p"))) * m.T_s
        fell = m.before("omega_u") - m.raw("omega_u")[m.first : m.last]
        by_droop = float(np.sum(fell)) * m.T_s / m.droop if self.net_of_droop else 0.0
        dE -= by_droop
        H = -math.copysign(1.0, self.df_hz) * m.f_n * dE / (2 * abs(self.df_hz))
        text = (
            f"In the window p gives {dE:.3g} p.u. s more than before"
            + (f" and than the {by_droop:.3g} p.u. s of the droop" if by_droop else "")
            + f", as an inertia constant of {H:.3g} s would; at least {self.least_s:g} s are asked."
        )
        return m.make_verdict(self.least_s <= H, H, "s", f"at least {self.least_s:g} s", text, "p")


CRITERION = Energy
