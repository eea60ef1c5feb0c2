"""A signal stays between two limits."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from gfm_hil.recording.columns import unit_of
from gfm_hil.run import checks
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import FAIL, Outcome, Verdict


class StaysWithin(Windowed):
    """The one-cycle means of a signal stay between two limits."""

    kind: Literal["stays_within"] = Field(description="kind of criterion")
    signal: str = Field("p", description="p, q, V, i, v_dc, f_hz or another recorded signal")
    low: float | None = Field(None, description="in the unit of the signal, p.u. or Hz")
    high: float | None = Field(None, description="in the unit of the signal, p.u. or Hz")
    of_before: bool = Field(
        False, description="low and high are parts of the mean of the last cycle before at"
    )
    longest_s: float = Field(0.0, ge=0, description="s that the signal may be beyond, in one piece")

    coarse: ClassVar[tuple[Outcome, ...]] = (FAIL,)  # between samples it may be beyond

    @model_validator(mode="after")
    def _limited(self) -> StaysWithin:
        if self.low is None and self.high is None:
            raise ValueError("low, high: give one of them or both")
        return self

    def judge(self, m: Moment) -> Verdict:
        """The value is the mean that comes nearest to a limit, or goes furthest beyond one."""
        w = m.window(self.signal)
        scale = w.before if self.of_before else 1.0
        low, high = (None if x is None else x * scale for x in (self.low, self.high))
        if scale < 0:  # of a negative value the lower limit is the upper one
            low, high = high, low
        below, above = (np.full(len(w.t), np.nan if x is None else x) for x in (low, high))
        found = checks.envelope(w, below, above, self.longest_s)
        least, most = float(np.min(w.x)), float(np.max(w.x))
        room = {
            least: math.inf if low is None else least - low,
            most: math.inf if high is None else high - most,
        }
        value = min(room, key=lambda x: room[x])
        band = " and ".join(
            f"{word} {w.show(x)}"
            for word, x in (("at least", low), ("at most", high))
            if x is not None
        )
        if self.longest_s:
            band += f", but for {self.longest_s:g} s"
        beyond = checks.longest_beyond(w, below, above)
        stay = f"The one-cycle mean of {w.symbol} stays between {least:.4g} and {w.show(most)}"
        if found is not None and beyond > 0:
            text = f"{found.text} It was beyond for {beyond:.3g} s in one piece."
        elif beyond > 0:
            text = f"{stay}; it is beyond its limits for {beyond:.3g} s in one piece."
        else:
            text = f"{stay}."
        return m.make_verdict(
            found is None, value, unit_of(self.signal), band, text, self.signal, low, high, m.span
        )


CRITERION = StaysWithin
