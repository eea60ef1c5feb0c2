"""The swing of p is damped."""

from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.run import checks
from gfm_hil.run.cycles import whole_ticks
from gfm_hil.run.modes import Oscillations, acting, free_from, oscillations
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict


class Damped(Windowed):
    """The swing of p after the event has at least a damping ratio."""

    kind: Literal["damped"] = Field(description="kind of criterion")
    ratio: float = Field(description="least damping ratio")

    def judge(self, m: Moment) -> Verdict:
        """The value is the damping ratio, or None where p does not swing."""
        w = m.window("p")
        acts = acting(m.run.scenario, m.run.columns, m.run.ticks)
        m.first = free_from(acts, m.first, m.last)
        if m.last - m.first < 2 * whole_ticks(m.width):
            return m.cannot_judge("what the event does to the grid is not over within the window")
        raw = replace(
            w,
            x=m.raw("p")[m.first : m.last],
            t=m.T_s * np.arange(m.first, m.last, dtype=np.float64),
        )
        return self.judge_modes(m, raw, oscillations(raw.x, m.T_s, m.f_n))

    def judge_modes(self, m: Moment, raw: checks.Window, modes: Oscillations) -> Verdict:
        """The verdict on p of every tick from where no event acts any more, and its modes."""
        found, mode = checks.damped(raw, self.ratio, modes), modes.swing
        value = None if mode is None else mode.damping
        if found is not None:
            text = found.text
        elif mode is None:
            text = "p does not swing."
        else:
            text = f"The swing of p at {mode.hz:.3g} Hz has a damping ratio of {mode.damping:.3g}."
        limit = f"damping ratio of at least {self.ratio:g}"
        return m.make_verdict(found is None, value, "", limit, text, "p")


CRITERION = Damped
