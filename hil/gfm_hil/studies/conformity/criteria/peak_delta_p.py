"""p moves by at least so much."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict


class PeakDelta(Windowed):
    """The one-cycle means of p move by at least so much from before, in the given direction."""

    kind: Literal["peak_delta_p"] = Field(description="kind of criterion")
    least: float = Field(gt=0, description="p.u.")
    direction: Literal["up", "down"] = Field(description="in which direction p must move")

    def judge(self, m: Moment) -> Verdict:
        """The value is the way to the peak, p.u."""
        w, sign, way = m.way(self.direction)
        word = "rises" if self.direction == "up" else "falls"
        text = (
            f"The one-cycle mean of p {word} by {way:.3g} p.u. at its peak"
            if way > 0
            else f"p does not go {self.direction} at all"
        )
        text += f"; at least {self.least:g} p.u. is asked."
        edge = w.before + sign * self.least
        low, high = (edge, None) if sign > 0 else (None, edge)
        limit = f"at least {self.least:g} p.u."
        return m.says(way >= self.least, way, "p.u.", limit, text, "p", low, high, m.span)


CRITERION = PeakDelta
