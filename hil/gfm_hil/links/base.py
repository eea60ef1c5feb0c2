"""The interface of a link: whole messages, never blocking for longer than told."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel, ConfigDict

from gfm_hil.core.roles import Side
from gfm_hil.links.port import Port

LONGEST = 504  # bytes of a message that every link carries, be it a frame or a greeting


class Link(Protocol):
    """One side's end of a link to exactly one peer.

    A message is delivered whole or not at all, and in order. Nothing is queued without bound:
    a message that the peer has no room for is dropped, and ``send`` says so.

    A link may have more methods. The handshake calls ``again()``, which reaches out anew to a peer
    that has not come, and ``connected()``, which says whether a peer is at the other end, with None
    where the link cannot know it. The loop calls ``start()`` before its first tick and ``stop()``
    after its last message.
    """

    @property
    def port(self) -> Port | None:
        """The same end for the compiled loops, or None: a thread then pumps its messages."""

    def send(self, message: bytes) -> bool:
        """Hand a message over; False if it had to be dropped."""

    def receive(self) -> bytes | None:
        """The next message, or None if none has arrived. Never blocks."""

    def wait(self, seconds: float) -> bool:
        """Sleep until a message has arrived (True) or the time is over (False)."""

    def close(self) -> None:
        """Let go of everything; what was sent last gets a fraction of a second to leave."""


class LinkOptions(BaseModel):
    """Base of a link's own options, the table ``link.options`` of a scenario."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _fits(options: Any, T_s: float) -> None:
    """Any options at any sampling time."""


def _may(endpoint: str | None, options: Any) -> None:
    """Any endpoint with any options."""


def _nothing(options: Any) -> None:
    """A link that compiles nothing."""


@dataclass(frozen=True)
class LinkKind:
    """What the bench knows of a link before it opens one.

    Attributes:
        name: as in ``link.type``.
        text: what it is, in a few words.
        pattern, form: what an endpoint must match, and the same in words.
        fresh: an endpoint for a run of our own, given a new empty folder of short path.
        open: opens the end of a side at an endpoint with checked options. Heavy imports belong
            in there. Raises ``UserError`` where the endpoint is not to be had.
        options: model of ``link.options``.
        check: sees that options fit the sampling time in s; raises ValueError in one line.
        check_both: sees that an endpoint (None: a fresh one) may be used with options; raises
            ValueError likewise.
        warm_up: compiles, or loads from numba's cache, what an end with these options calls.
        exact: float64 arrives as sent, so that results are those of a run in process.
    """

    name: str
    text: str
    pattern: str
    form: str
    fresh: Callable[[Path], str]
    open: Callable[[Side, str, Any], Link]
    options: type[LinkOptions] = LinkOptions
    check: Callable[[Any, float], None] = _fits
    check_both: Callable[[str | None, Any], None] = _may
    warm_up: Callable[[Any], None] = _nothing
    exact: bool = True

    def check_endpoint(self, endpoint: str) -> None:
        """Raises ValueError if it is not of this link's form."""
        if re.fullmatch(self.pattern, endpoint) is None:
            raise ValueError(f"endpoint = {endpoint!r}: must be {self.form}")
