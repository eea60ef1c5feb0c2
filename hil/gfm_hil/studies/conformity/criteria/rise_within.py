"""A signal rises fast enough, and does not fall back."""

import math
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.run.cycles import whole_ticks
from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict

_NO_RISE = 0.02  # p.u.; of a smaller peak no rise time is told
_HELD_S = 0.1  # s after it has risen in which it must not fall back
_NEAR = 0.9  # of the way: as long as the means come back to it p is at its peak
_BACK = 0.5  # of ``part``: below that it has fallen back, and as far the wrong way is one


class Rise(Windowed):
    """A signal has done a part of its way to the peak of its one-cycle means within a time, has not
    gone half as far the wrong way first, and does not fall below half of the part again for 0.1 s
    or until it has left its peak. It is low-passed at the nominal frequency: a mean over a cycle
    would hide the rise, and in the bare signal a spike of the circuit would pass for one. With
    ``mean`` it is the mean over the last cycle: the size of a current whose phases have an offset,
    as after a fault, swings at the nominal frequency."""

    kind: Literal["rise_within"] = Field(description="kind of criterion")
    signal: str = Field("p", description="as for stays_within")
    part: float = Field(0.9, gt=0, lt=1, description="of the way to the peak")
    within: float = Field(gt=0, description="s after at")
    direction: Literal["up", "down"] = Field(description="in which direction it must move")
    mean: bool = Field(
        False, description="true: by its mean over the last cycle, as of a fault's current"
    )

    def finest_s(self, cycle_s: float) -> float:
        """A fifth of the time that it may take, or that of any clause."""
        return min(self.within / 5, super().finest_s(cycle_s))

    def judge(self, m: Moment) -> Verdict:
        """The value is the time that it takes, ms."""
        w, sign, way = m.excursion(self.signal, self.direction)
        if way < _NO_RISE:
            return m.cannot_judge(f"{w.symbol} goes {self.direction} by {max(way, 0.0):.2g} only")
        x = (
            m.means(self.signal, m.tick + 1 - whole_ticks(m.width), m.last)
            if self.mean
            else m.low_passed(self.signal, m.tick, m.last)
        )
        done = sign * (x - w.before) / way
        there = done >= self.part
        k = int(np.argmax(there)) if there.any() else len(done)
        took = k * m.T_s if there.any() else math.inf
        near = np.flatnonzero(sign * (w.x - w.before) >= _NEAR * way)
        peak = m.first - m.tick + int(near[-1]) + round(0.5 * m.width)
        held = done[k : min(peak, k + round(_HELD_S / m.T_s))]
        lost = np.flatnonzero(held < _BACK * self.part)
        text = (
            f"{w.symbol} has done {100 * self.part:g} % of its way to the peak, which is a change "
            f"of {way:.3g}, after {1e3 * took:.3g} ms; at most {1e3 * self.within:g} ms are allowed"
        )
        wrong = float(np.min(done[:k], initial=0.0)) < -_BACK * self.part
        if wrong:
            text += f"; before that it goes the wrong way, by {-np.min(done[:k]) * way:.3g}"
        if len(lost):
            text += f", and {1e3 * (k + lost[0]) * m.T_s:.3g} ms after the event it falls back"
        ok = took <= self.within + 1e-9 and not wrong and not len(lost)
        limit = f"within {1e3 * self.within:g} ms, without falling back"
        return m.make_verdict(ok, 1e3 * took, "ms", limit, text, self.signal)


CRITERION = Rise
