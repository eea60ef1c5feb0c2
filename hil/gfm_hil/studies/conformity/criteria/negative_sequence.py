"""The converter gives a current of the negative sequence against an unbalance."""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Vector, Windowed
from gfm_hil.studies.conformity.verdict import Verdict

_LEAST_V = 0.01  # p.u.; a smaller voltage of the negative sequence has no angle worth judging


class NegativeSequence(Windowed):
    """The current of the negative sequence, of L_f towards the grid, is at least so large, and
    leads the voltage of the negative sequence at the filter by an angle between two limits. Both
    are phasors over the last cycle of each tick; their means count."""

    kind: Literal["negative_sequence"] = Field(description="kind of criterion")
    least: float = Field(gt=0, description="least current of the negative sequence, p.u.")
    leads_low: float = Field(-180.0, ge=-180, le=360, description="least lead, degrees")
    leads_high: float = Field(180.0, ge=-180, le=360, description="largest lead, degrees")

    def judge(self, m: Moment) -> Verdict:
        """The value is the lead, degrees, or the current, p.u., if that is too small."""
        v, i = (phasor(m, name) for name in ("v", "i"))
        size, across = float(np.mean(np.abs(i))), float(np.mean(np.abs(v)))
        if across < _LEAST_V:
            return m.cannot_judge(f"the voltage of the negative sequence is only {across:.2g} p.u.")
        middle = 0.5 * (self.leads_low + self.leads_high)
        lead = math.degrees(float(np.angle(np.mean(i * np.conj(v)))))
        lead = middle + (lead - middle + 180.0) % 360.0 - 180.0
        text = (
            f"The current of the negative sequence is {size:.3g} p.u. at a voltage of "
            f"{across:.3g} p.u., which it leads by {lead:.3g}°."
        )
        limit = (
            f"at least {self.least:g} p.u., {self.leads_low:g}° to {self.leads_high:g}° ahead of "
            "the voltage"
        )
        ok = size >= self.least and self.leads_low <= lead <= self.leads_high
        value, unit = (lead, "°") if size >= self.least else (size, "p.u.")
        return m.make_verdict(ok, value, unit, limit, text, "i")


def phasor(m: Moment, name: str) -> Vector:
    """The phasors of the negative sequence of v or i in the window, complex, p.u., one a tick: the
    conjugate of the one-cycle means of the space vector x e^(2j w_n t), which turns at w_n."""
    t = m.T_s * np.arange(m.first, m.last)
    x = (m.raw(f"{name}_re") + 1j * m.raw(f"{name}_im"))[m.first : m.last]
    turned = x * np.exp(4j * math.pi * m.f_n * t)
    return m.mean_of(turned.real) - 1j * m.mean_of(turned.imag)


CRITERION = NegativeSequence
