"""The interface of a link: it carries whole messages and never blocks past the given timeout."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self

from pydantic import BaseModel, ConfigDict, PrivateAttr, ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.roles import Role
from gfm_hil.links.port import Port
from gfm_runtime.signals import PLAIN

LONGEST = 504  # bytes: every link carries a message, frame or greeting, up to this length


class Link(Protocol):
    """One side's end of a link to exactly one peer.

    The link delivers a message whole or not at all, and in order. Its queues are bounded: it drops
    a message that the peer has no room for, and ``send`` returns False.

    A link may have more methods. The handshake calls ``again()``, which retries the connection
    while the peer has not come, and ``connected()``, which returns whether a peer is at the other
    end, or None if the link cannot know. The loop calls ``start()`` before its first tick and
    ``stop()`` after its last message.
    A slow link has ``every``, the number of ticks to an exchange of y and u: the loops then send
    only at every such tick.
    """

    @property
    def port(self) -> Port | None:
        """The same end for the compiled loops; if it is None, a thread pumps the messages."""

    def send(self, message: bytes) -> bool:
        """Send a message; False if the link dropped it."""

    def receive(self) -> bytes | None:
        """The next message, or None if none has arrived. Never blocks."""

    def wait(self, seconds: float) -> bool:
        """Sleep until a message has arrived (True) or the timeout has expired (False)."""

    def close(self) -> None:
        """Free all resources; the last messages get a fraction of a second to be sent."""


def unusable(endpoint: str, verb: str, why: object) -> UserError:
    """The error of an end that cannot be ``verb`` (bound, opened, joined) at its endpoint."""
    return UserError(f"link.endpoint = {endpoint!r}: cannot be {verb}: {why}")


def wait_until(ready: Callable[[], bool], until: float, first_s: float, most_s: float) -> bool:
    """Sleep until ``ready()`` (True), or until ``time.monotonic()`` is ``until``, s (False).

    Each sleep is twice as long as the one before it, from ``first_s`` to ``most_s``.
    """
    while not ready():
        left = until - time.monotonic()
        if left <= 0:
            return False
        time.sleep(min(first_s, left))
        first_s = min(2 * first_s, most_s)
    return True


class LinkOptions(BaseModel):
    """Base class of a link's own options, the table ``link.options`` of a scenario."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
    _signal_set: int = PrivateAttr(PLAIN)

    @property
    def signal_set(self) -> int:
        """What the frames carry, as the laws of the run say and not the user: ``PLAIN``, ``INNER``
        or ``COUNTS`` of ``gfm_runtime.signals``."""
        return self._signal_set

    def of_run(self, signal_set: int) -> Self:
        """The same options in a run with this signal set."""
        options = self.model_copy()
        options._signal_set = signal_set
        return options


@dataclass(frozen=True)
class LinkKind:
    """What the bench knows of a link before it opens one."""

    name: str  # as in ``link.type``
    text: str  # what it is, in a few words
    # pattern, form: the regular expression that an endpoint must match, and the same in words
    pattern: str
    form: str
    # makes an endpoint for a new run, given a new empty folder with a short path
    fresh: Callable[[Path], str]
    # opens one side's end at an endpoint with checked options. Heavy imports belong in there.
    # Raises ``UserError`` if it cannot use the endpoint
    open: Callable[[Role, str, Any], Link]
    options: type[LinkOptions] = LinkOptions  # model of ``link.options``
    # checks the options against the sampling time in s; raises ValueError in one line
    check: Callable[[Any, float], None] = lambda options, T_s: None
    # checks that an endpoint (None: a fresh one) may be used with the options; raises ValueError
    # likewise
    check_both: Callable[[str | None, Any], None] = lambda endpoint, options: None
    # compiles, or loads from numba's cache, what an end with these options calls
    warm_up: Callable[[Any], None] = lambda options: None
    # float64 values arrive as sent, so that results equal those of a run in process
    exact: bool = True

    def checked(
        self, endpoint: str | None, options: dict[str, Any], signal_set: int = PLAIN
    ) -> LinkOptions:
        """The options as a model, if endpoint (None: a fresh one) and options may be used.

        ``signal_set``: of the run. Raises ValueError: they may not; one line.
        """
        if endpoint is not None and re.fullmatch(self.pattern, endpoint) is None:
            raise ValueError(f"endpoint = {endpoint!r}: must be {self.form}")
        try:
            found = self.options.model_validate(options)
        except ValidationError as problem:
            wrong = lines(problem, self.options)
            raise ValueError("; ".join(f"options.{line}" for line in wrong)) from None
        self.check_both(endpoint, found)
        return found.of_run(signal_set)
