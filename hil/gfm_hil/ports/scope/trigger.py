"""The trigger of a scope: finds the exact tick of an edge and holds the picture around it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gfm_hil.ports.scope.pyramid import Pyramid

_AT_ONCE = 200_000  # most ticks searched between two pictures; older ones are skipped
_AUTO_S = 0.5  # or a picture's length, if longer: without an edge, AUTO then shows the newest

#: states of an acquisition
IDLE, ARMED, FILLING, AUTO, HELD = range(5)


class Trigger(BaseModel):
    """The trigger condition and mode."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    channel: str = Field(max_length=40)
    level: float = Field(ge=-1e9, le=1e9)
    edge: Literal["rising", "falling", "both"] = "rising"
    mode: Literal["auto", "normal", "single"] = "auto"
    before: float = Field(0.2, ge=0, le=1, description="part of the picture before the edge")


def edges(values: NDArray[np.float32], trigger: Trigger) -> NDArray[np.intp]:
    """Indices k ≥ 1 at which ``values`` crosses the level from k-1 to k."""
    known = np.isfinite(values)
    above = values >= trigger.level
    found = (above[1:] != above[:-1]) & known[1:] & known[:-1]
    if trigger.edge != "both":
        found &= above[1:] == (trigger.edge == "rising")
    return np.flatnonzero(found) + 1


class Acquisition:
    """The running trigger of one view.

    Args:
        pyramid: to search.
        trigger, span: the condition; ticks in a picture.
        start: the first tick that may be an edge.
    """

    def __init__(self, pyramid: Pyramid, trigger: Trigger, span: int, start: int) -> None:
        self._pyramid, self._trigger = pyramid, trigger
        self._span, self._before = span, round(span * trigger.before)
        self._searched = self._since = start
        self._at = -1  # edge of the picture that is filling
        self.shown = -1  # edge of the displayed picture, or -1
        self.doing = ARMED
        self._auto = max(round(_AUTO_S / pyramid.record.T_s), span)

    def window(self, head: int) -> tuple[int, int]:
        """The displayed ticks when ``head`` ticks are done."""
        self._look(head)
        if self.shown >= 0:
            first = self.shown - self._before
            return first, first + self._span
        last = max(head, self._span)
        return last - self._span, last

    def _look(self, head: int) -> None:
        if self._at >= 0 and head >= self._at - self._before + self._span:  # the picture is full
            self._since = head
            if self._trigger.mode == "single":
                self.doing = HELD
                return
            after = self._at - self._before + self._span
            self._searched, self._at = max(after, head - 2 * self._span), -1
            self.doing = ARMED
        if self._at < 0 and self.doing != HELD:
            self._at = self._search(head)
            if self._at >= 0:
                self.shown, self.doing = self._at, FILLING
            elif self._trigger.mode == "auto" and head - self._since > self._auto:
                self.shown, self.doing = -1, AUTO

    def _search(self, head: int) -> int:
        first, self._searched = max(self._searched, head - _AT_ONCE, 1), max(head, self._searched)
        if first >= head:
            return -1
        found = edges(self._pyramid.values(self._trigger.channel, first - 1, head), self._trigger)
        return first - 1 + int(found[0]) if len(found) else -1
