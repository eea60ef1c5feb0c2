"""One picture of a scope: its trigger, its ticks, its bins, and the bytes that the page decodes.

A frame is little-endian: the numbers of ``HEAD`` as float64; then, for each channel of the view in
order, float32 minimum and maximum of every bin; then float32 mean, over the last 20 ms, of each of
them and of the watched channels.
"""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from gfm_hil.ports.scope.pyramid import Pyramid

HEAD = {
    "view": "the `id` of the `look` that it answers",
    "first": "tick at which the first bin begins",
    "width": "ticks in a bin",
    "bins": "their number; 0 if `same`",
    "channels": "their number",
    "start": "tick at which the window begins; may lie before the first one, or between two",
    "stop": "tick at which it ends",
    "head": "ticks done",
    "edge": "tick of the trigger's edge, or -1",
    "doing": "of the trigger: 0 nothing, 1 armed, 2 its picture fills, 3 auto, 4 held",
    "state": "of the controller: 0 INIT, 1 READY, 2 RUNNING, 3 SAFE, 4 STOPPED, or -1",
    "law": "index into the `labels` of `about`, or -1",
    "misses": "so far",
    "trip": "code of what the protection saw; 0: nothing",
    "same": "1: the bins are those of the picture before and left out",
    "live": "1: the run may still go on",
}
_NOW_S = 0.02
_AT_ONCE = 200_000  # most ticks searched between two pictures; older ones are skipped
_AUTO_S = 0.5  # or a picture's length, if longer: without an edge, AUTO then shows the newest

#: states of an acquisition
IDLE, ARMED, FILLING, AUTO, HELD = range(5)


class PageMessage(BaseModel):
    """What a page sends, or a part of it."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Trigger(PageMessage):
    """The trigger condition and mode."""

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
        self._update(head)
        if self.shown >= 0:
            first = self.shown - self._before
            return first, first + self._span
        last = max(head, self._span)
        return last - self._span, last

    def _update(self, head: int) -> None:
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


ChannelName = Annotated[str, Field(max_length=40)]


class PictureRequest(PageMessage):
    """A page's request for pictures."""

    kind: Literal["look"]
    id: int = Field(ge=0, lt=2**53)  # a frame carries it as float64
    channels: list[ChannelName] = Field(max_length=40)
    watched: list[ChannelName] = Field(default=[], max_length=24)
    bins: int = Field(ge=16, le=4096)
    mode: Literal["roll", "held", "trigger"]
    span: float = Field(gt=0, le=1e6, description="s")
    start: float = Field(0.0, ge=-1e6, le=1e6, description="of a window that is held, s")
    trigger: Trigger | None = None


class ScopePicture:
    """A page's look at a recording. Raises ValueError: a channel does not exist, or the trigger is
    missing.

    Args:
        pyramid: of the recording.
        request: of the page.
        head: ticks done at the request.
    """

    def __init__(self, pyramid: Pyramid, request: PictureRequest, head: int) -> None:
        triggers = [request.trigger.channel] if request.trigger else []
        for name in (*request.channels, *request.watched, *triggers):
            if name not in pyramid:
                raise ValueError(f"channel = {name!r}: unknown")
        self._pyramid, self._request = pyramid, request
        self._span = max(2, round(request.span / pyramid.record.T_s))
        self._acquisition = None
        if request.mode == "trigger":
            if request.trigger is None:
                raise ValueError("trigger: missing")
            self._acquisition = Acquisition(pyramid, request.trigger, self._span, head)
        self._width = pyramid.width(self._span, request.bins)
        self._now = max(1, round(_NOW_S / pyramid.record.T_s))
        self._sent: tuple[float, ...] = ()

    def frame(self, head: int) -> bytes | None:
        """The picture when ``head`` ticks are done; None if it equals the last one."""
        start, stop, doing, edge = self._window(head)
        first = max(0, int(start // self._width))
        last = int(-(-min(stop, head) // self._width))
        bins = max(0, last - first)
        live = self._pyramid.record.live
        what = (start, stop, min(stop, head), float(edge))
        same = self._sent[:4] == what
        if same and self._sent[4:] == (head, doing, live):
            return None
        self._sent = (*what, head, doing, live)
        names = self._request.channels
        numbers = [
            self._request.id, first * self._width, self._width, 0 if same else bins, len(names),
            start, stop, head, edge, doing, self._last("state", head), self._last("law", head),
            self._pyramid.misses(head), self._last("true_trip", head), same, live,
        ]  # fmt: skip
        parts = [np.asarray(numbers, "<f8")]
        if bins and not same:
            for name in names:
                parts += self._pyramid.bins(name, first, last, self._width)
        now = [self._mean(name, head) for name in (*names, *self._request.watched)]
        return b"".join([*(p.tobytes() for p in parts), np.asarray(now, "<f4").tobytes()])

    def _window(self, head: int) -> tuple[float, float, int, int]:
        if self._acquisition is not None:
            start, stop = self._acquisition.window(head)
            return start, stop, self._acquisition.doing, self._acquisition.shown
        if self._request.mode == "held":
            at = self._request.start / self._pyramid.record.T_s
            return at, at + self._span, HELD, -1
        return max(0, head - self._span), max(head, self._span), IDLE, -1

    def _last(self, column: str, head: int) -> float:
        """A column at the newest tick; -1 if unknown."""
        rows = self._pyramid.record.columns.get(column)
        value = float(rows[head - 1 : head][0]) if rows is not None and head > 0 else np.nan
        return value if np.isfinite(value) else -1

    def _mean(self, name: str, head: int) -> float:
        values = self._pyramid.values(name, max(0, head - self._now), head)
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else np.nan
