"""p rises fast enough."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from pydantic import Field

from gfm_hil.studies.conformity.criteria.base import Moment, Windowed
from gfm_hil.studies.conformity.verdict import Verdict

_NO_RISE = 0.02  # p.u.; of a smaller peak no rise time is told


class Rise(Windowed):
    """p has done a part of its way to the peak of its one-cycle means within a time; every tick
    counts, since a mean over a cycle would hide it."""

    kind: Literal["rise_within"] = Field(description="kind of criterion")
    part: float = Field(0.9, gt=0, lt=1, description="of the way to the peak")
    within: float = Field(gt=0, description="s after at")
    direction: Literal["up", "down"] = Field(description="in which direction p must move")

    def judge(self, m: Moment) -> Verdict:
        """The value is the time that it takes, ms."""
        w, sign, way = m.way(self.direction)
        if way < _NO_RISE:
            return m.cannot(f"p goes {self.direction} by {max(way, 0.0):.2g} p.u. only")
        there = sign * (m.raw("p")[m.tick : m.last] - w.before) >= self.part * way
        took = float(np.argmax(there)) * m.T_s if there.any() else math.inf
        text = (
            f"p has done {100 * self.part:g} % of its way to the peak, which is a change of "
            f"{way:.3g} p.u., after {1e3 * took:.3g} ms; at most {1e3 * self.within:g} ms are "
            "allowed."
        )
        limit = f"within {1e3 * self.within:g} ms"
        return m.says(took <= self.within + 1e-9, 1e3 * took, "ms", limit, text, "p")


CRITERION = Rise
