"""The swing of p is adequately damped, as the Australian rules define it."""

import math
from typing import Literal

from pydantic import Field

from gfm_hil.run import checks
from gfm_hil.run.modes import Oscillation, Oscillations
from gfm_hil.studies.conformity.criteria.base import Moment
from gfm_hil.studies.conformity.criteria.damped import Damped
from gfm_hil.studies.conformity.verdict import Verdict

_FAST = 0.6  # Hz; from there on the damping ratio counts, below it the halving time


class AdequatelyDamped(Damped):
    """The swing of p after the event is adequately damped, as chapter 10 of the Australian National
    Electricity Rules defines it: below 0.6 Hz by the time in which it halves, from there by its
    damping ratio. In the 2 s that are looked at there is no swing below 0.25 Hz, and so nothing to
    judge by what the rules ask below 0.05 Hz, a ratio of 0.4."""

    kind: Literal["adequately_damped"] = Field(description="kind of criterion")  # type: ignore[assignment]
    ratio: float = Field(0.05, description="least damping ratio from 0.6 Hz on")
    halving_s: float = Field(5.0, gt=0, description="longest halving time below, s")

    def judge_modes(self, m: Moment, raw: checks.Window, modes: Oscillations) -> Verdict:
        """The value is the halving time, s, or the damping ratio, or None without a swing."""
        mode = modes.swing
        if mode is None or mode.hz >= _FAST:
            return super().judge_modes(m, raw, modes)
        halves = halving_s(mode)
        text = f"The swing of p at {mode.hz:.3g} Hz " + (
            f"halves in {halves:.3g} s." if halves < math.inf else "does not decay."
        )
        limit = f"halves within {self.halving_s:g} s"
        value = halves if halves < math.inf else None
        return m.make_verdict(halves <= self.halving_s, value, "s", limit, text, "p")


def halving_s(mode: Oscillation) -> float:
    """The time in which an oscillation halves, s: ln 2 over its decay rate; inf if it has none."""
    decay = mode.damping / math.sqrt(1 - mode.damping**2) * 2 * math.pi * mode.hz
    return math.log(2) / decay if decay > 0 else math.inf


CRITERION = AdequatelyDamped
