"""The interface of a link: whole messages, never blocking for longer than told."""

from __future__ import annotations

from typing import Literal, Protocol

Side = Literal["controller", "plant"]
SIDES: tuple[Side, ...] = ("controller", "plant")


class Link(Protocol):
    """One side's end of a link to exactly one peer.

    A message is delivered whole or not at all, and in order. Nothing is queued without bound:
    a message that the peer has no room for is dropped, and ``send`` says so.
    """

    def send(self, message: bytes) -> bool:
        """Hand a message over; False if it had to be dropped."""

    def receive(self) -> bytes | None:
        """The next message, or None if none has arrived. Never blocks."""

    def wait(self, seconds: float) -> bool:
        """Sleep until a message has arrived (True) or the time is over (False)."""

    def close(self) -> None:
        """Let go of everything; what was sent last gets a fraction of a second to leave."""


class LinkFactory(Protocol):
    """Opens one end of a link."""

    def __call__(self, side: Side, endpoint: str) -> Link:
        """Open the end of ``side`` at ``endpoint``.

        Raises:
            gfm_hil.errors.UserError: the endpoint is malformed or occupied.
        """
