"""p answers a phase jump as a swing equation with such a damping ratio would."""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.core.errors import UserError
from gfm_hil.run.cycles import whole_ticks
from gfm_hil.scenario.events.phase_jump import PhaseJump
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict
from gfm_hil.studies.envelopes import Unit, fit_jump

_SAMPLES = 800  # of the fit


class EquivalentDamping(Windowed):
    """The damping ratio of the swing equation that fits the answer of p to a phase jump lies
    between two limits. It may be above 1, where p does not swing."""

    kind: Literal["equivalent_damping"] = Field(description="kind of criterion")
    low: float = Field(ge=0, description="least damping ratio")
    high: float = Field(gt=0, description="largest damping ratio")

    def judge(self, m: Moment) -> Verdict:
        """The value is the damping ratio."""
        jumps = [e for e in m.run.scenario.events if isinstance(e, PhaseJump)]
        jump = next((e for e in jumps if e.at(m.T_s) == m.tick), None)
        if jump is None:
            return m.cannot_judge("its time is not that of a phase jump")
        w, omega_b = m.window("p"), 2 * math.pi * m.f_n
        every = max(1, len(w.t) // _SAMPLES)
        t, change = (w.t - m.at)[::every], (w.x - w.before)[::every]
        skip = 1.5 * whole_ticks(m.width) * m.T_s  # the circuit's own answer
        try:
            unit = fit_jump(t, change, np.radians(jump.degrees), omega_b, 0.0, skip)
        except UserError as problem:
            return m.cannot_judge(f"no swing equation fits the answer of p: {problem}")
        ratio, text = damping_of(unit, omega_b)
        ok = self.low <= ratio <= self.high
        limit = f"damping ratio of {self.low:g} to {self.high:g}"
        return m.make_verdict(ok, ratio, "", limit, text, "p")


def damping_of(unit: Unit, omega_b: float) -> tuple[float, str]:
    """The damping ratio of a unit whose X_eff is that of the whole path, and a sentence about it;
    omega_b in rad/s."""
    ratio = unit.damping_ratio(unit.X_eff, omega_b)
    return ratio, (
        f"p answers as a swing equation with D = {unit.D:.3g}, {unit.inertia()} on "
        f"{unit.X_eff:.3g} p.u. would, whose damping ratio is {ratio:.3g}."
    )


CRITERION = EquivalentDamping
