"""A signal moves by at least so much."""

from typing import ClassVar, Literal

from pydantic import Field

from gfm_hil.recording.columns import unit_of
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import PASS, Outcome, Verdict


class PeakDelta(Windowed):
    """The one-cycle means of a signal move by at least so much from before, in the given
    direction."""

    kind: Literal["peak_delta"] = Field(description="kind of criterion")
    signal: str = Field("p", description="as for stays_within")
    least: float = Field(gt=0, description="in the unit of the signal")
    direction: Literal["up", "down"] = Field(description="in which direction it must move")

    coarse: ClassVar[tuple[Outcome, ...]] = (PASS,)  # between samples the peak may be higher

    def judge(self, m: Moment) -> Verdict:
        """The value is the way to the peak, in the unit of the signal."""
        w, sign, way = m.excursion(self.signal, self.direction)
        word, unit = "rises" if self.direction == "up" else "falls", unit_of(self.signal)
        text = (
            f"The one-cycle mean of {w.symbol} {word} by {way:.3g} {unit} at its peak"
            if way > 0
            else f"{w.symbol} does not go {self.direction} at all"
        )
        text += f"; at least {self.least:g} {unit} is asked."
        edge = w.before + sign * self.least
        low, high = (edge, None) if sign > 0 else (None, edge)
        limit = f"at least {self.least:g} {unit}"
        return m.make_verdict(
            way >= self.least, way, unit, limit, text, self.signal, low, high, m.span
        )


CRITERION = PeakDelta
