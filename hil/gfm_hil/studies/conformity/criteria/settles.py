"""A signal settles at a value."""

import math
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from gfm_hil.recording.columns import unit_of
from gfm_hil.run import checks
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import FAIL, LIMITED, PASS, Outcome, Verdict

_ROUNDING = 1e-9  # p.u. of power; a droop that asks for no more than this beyond a limit is met


class Settles(Windowed):
    """The one-cycle means of a signal come within a tolerance of a value and stay there. Where the
    declared droop asks for more than the declared power, p has to settle there, and the verdict is
    ``limited``: the limiter was judged, and not the droop."""

    kind: Literal["settles"] = Field(description="kind of criterion")
    signal: str = Field("p", description="as for stays_within")
    to: float | Literal["before", "droop", "grid"] = Field(
        description="value; before: the mean of the last cycle before at; droop: where the "
        "declared droop and power limits put p at the frequency that the converter has; grid: for "
        "f_hz, the frequency of the grid at the end"
    )
    tolerance: float = Field(gt=0, description="in the unit of the signal")
    within: float = Field(gt=0, description="s after at")

    coarse: ClassVar[tuple[Outcome, ...]] = (PASS, FAIL, LIMITED)

    def judge(self, m: Moment) -> Verdict:
        """The value is the time that it takes, s."""
        w = m.window(self.signal)
        to, why, limited = self._aim(m, w)
        if w.t[-1] < m.at + self.within:
            return m.cannot_judge(f"its window ends before {self.within:g} s have passed")
        found = checks.settles(w, to, self.within, self.tolerance)
        took = checks.settled_after(w, to, self.tolerance)
        if found is None:
            text = f"{w.symbol} settles at {w.show(to)} ({why}) after {took:.3g} s."
            if limited:
                text = f"Limited: judged on the limiter. {text}"
        else:
            text = found.text.replace(
                f"{w.symbol} should settle at {w.show(to)}",
                f"The one-cycle mean of {w.symbol} should settle at {w.show(to)} ({why})",
                1,
            )
        limit = f"within {self.within:g} s, ± {self.tolerance:g} {unit_of(self.signal)}"
        made = m.make_verdict(
            found is None, took, "s", limit, text, self.signal,
            to - self.tolerance, to + self.tolerance, (m.at + self.within, m.last * m.T_s),
        )  # fmt: skip
        return replace(made, verdict=LIMITED) if limited and found is None else made

    def _aim(self, m: Moment, w: checks.Window) -> tuple[float, str, bool]:
        """Where it must settle, why there, and whether that is at a limit of the power."""
        if self.to == "before":
            return w.before, "its value before", False
        if self.to == "grid":
            return m.mean_at_end("omega_g") * m.f_n, "the frequency of the grid", False
        if self.to != "droop":
            return self.to, "the value asked for", False
        omega_u, under = m.mean_at_end("omega_u"), m.under
        asked = m.mean_at_end("ref_P_ref") + (1.0 - omega_u) / m.droop
        to = float(np.clip(asked, under.P_min, under.P_max))
        droop = "no droop" if math.isinf(m.droop) else f"the declared droop of {100 * m.droop:g} %"
        why = f"{droop} at {omega_u * m.f_n:.4g} Hz"
        limited = abs(to - asked) > _ROUNDING
        if limited:
            why += f", which asks for {asked:.3g} p.u., limited to the declared power"
        return to, why, limited


CRITERION = Settles
