"""The start: both sides show what they are about to run, and refuse what does not fit.

Plant: HELLO every 100 ms until answered. Controller: HELLO back. Plant: START with the time of
tick 0. Messages are JSON; frames begin only after START. The plant sends START once. If the
link loses it, the first frame that arrives tells the controller when tick 0 was.

A side refuses and counts a malformed greeting, and goes on waiting. It shows what a peer said only
escaped and cut.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from gfm_hil.core.errors import PeerLost, lines
from gfm_hil.core.roles import Side
from gfm_hil.engine.waiting import await_message
from gfm_hil.links import Link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameError, FrameReader
from gfm_hil.scenario.model import Scenario
from gfm_runtime.signals import NY, TABLE_VERSION, table_hash

_PREFIX = b"GFMHIL "
_REPEAT_NS = 100_000_000
_AGAIN_NS = 2_000_000_000  # after which a link that can do so connects again
_LEAD_NS = 20_000_000  # from START to tick 0
_MOST_LEAD_NS = 10_000_000_000  # of a plant that is not ours
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # of Linux; CLOCK_MONOTONIC counts from that boot

#: what both sides must have in common, in the order of checking, and its name in words
_MUST_FIT = {
    "version": "version of the signal table",
    "table": "signal table",
    "T_s": "sampling time T_s",
    "laws": "law or law file",
    "digest": "scenario",
}

Notice = Callable[[str], None]


_Text = Annotated[str, Field(max_length=100)]


class _Greeting(BaseModel):
    """A foreign controller may send more fields than ours; they are ignored."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=False)


class _Hello(_Greeting):
    kind: Literal["hello"]
    side: Side
    boot: _Text
    version: int = Field(ge=0, lt=2**31)
    table: _Text
    T_s: float = Field(gt=0.0)
    laws: _Text
    digest: _Text


class _Go(_Greeting):
    kind: Literal["start"]
    t0: int = Field(ge=0, lt=2**63)  # ns of the plant's CLOCK_MONOTONIC


_GREETING: TypeAdapter[_Hello | _Go] = TypeAdapter(
    Annotated[_Hello | _Go, Field(discriminator="kind")]
)


@dataclass(frozen=True)
class Start:
    """What both sides agreed on.

    Attributes:
        t0_ns: time of tick 0 on our own CLOCK_MONOTONIC. If the other side has another clock, the
            controller's value is late by the travel time of START.
        one_clock: both sides run on one machine.
        refused: how many malformed greetings came.
    """

    t0_ns: int
    one_clock: bool
    refused: int


class _Refused(Exception):
    """A malformed greeting; says what is wrong with it."""


class _Heard:
    """Counts what came over a link other than a good greeting.

    Attributes:
        refused: malformed messages that begin as a greeting does.
    """

    def __init__(self, link: Link) -> None:
        self._connected = getattr(link, "connected", _nothing)
        self.refused, self._others, self._why = 0, 0, ""

    def refuse(self, why: _Refused) -> None:
        """Count a greeting."""
        self.refused, self._why = self.refused + 1, str(why)

    def no_greeting(self) -> None:
        """Count a message that does not begin as a greeting."""
        self._others += 1

    def __str__(self) -> str:
        if self.refused:
            return f"; greetings refused: {self.refused}, the last one because {self._why}"
        if self._others:
            return f"; messages that are no greeting: {self._others}"
        return "; a peer is connected but says nothing" if self._connected() else ""


def shake_hands(
    side: Side, link: Link, scenario: Scenario, stopped: Callable[[], bool], notice: Notice
) -> Start:
    """Meet the other side and agree on the time of tick 0.

    Calls ``notice`` within a second, and then every five, with what it waits for and what came
    instead.

    Raises:
        PeerLost: no good greeting came within ``link.start_timeout_s``, or the other side runs
            something else.
    """
    boot = _boot()
    mine = {"side": side, "boot": boot, **_what_runs(scenario)}
    begin = time.monotonic_ns()
    deadline = begin + int(scenario.link.start_timeout_s * 1e9)
    say_at, again_at = begin + 500_000_000, begin + _AGAIN_NS
    other = "plant" if side == "controller" else "controller"
    met = one_clock = False
    answered = -_REPEAT_NS
    heard = _Heard(link)
    while not stopped():
        if side == "plant":
            link.send(_PREFIX + json.dumps({**mine, "kind": "hello"}).encode())
        message = await_message(link, min(time.monotonic_ns() + _REPEAT_NS, deadline), stopped)
        now = time.monotonic_ns()
        try:
            greeting = None if message is None else _read(message)
            if isinstance(greeting, _Hello):
                # answer first, so that both sides see a misfit, and once for all queued greetings
                if side == "controller" and now - answered >= _REPEAT_NS:
                    answered = now
                    link.send(_PREFIX + json.dumps({**mine, "kind": "hello"}).encode())
                _compare(mine, greeting)
                one_clock = bool(boot) and greeting.boot == boot
                if not met:  # the peer is there: from now on its silence is a fault
                    met, deadline = True, now + int(scenario.link.peer_timeout_s * 1e9)
                if side == "plant":
                    start = now + _LEAD_NS
                    go: dict[str, Any] = {"kind": "start", "t0": start}
                    link.send(_PREFIX + json.dumps(go).encode())
                    return Start(start, one_clock, heard.refused)
            elif isinstance(greeting, _Go) and met:
                if not one_clock:
                    return Start(now + _LEAD_NS, one_clock, heard.refused)
                _check_time(greeting.t0, begin, now)
                return Start(greeting.t0, one_clock, heard.refused)
            elif message is not None and greeting is None:
                tick = _tick(message, scenario) if met else None
                if tick is not None:  # the plant runs already: START was lost
                    t0 = now - round(tick * scenario.T_s * 1e9)
                    return Start(t0, one_clock, heard.refused)
                heard.no_greeting()
        except _Refused as problem:
            heard.refuse(problem)
        if now >= deadline:
            break
        if now >= again_at and not met:
            getattr(link, "again", _nothing)()
            again_at = now + _AGAIN_NS
        if now >= say_at and not met:
            notice(f"waiting for the {other} at {scenario.link.endpoint} …{heard}")
            say_at = now + 5_000_000_000
    if stopped():
        raise PeerLost(f"interrupted while waiting for the {other}{heard}")
    if met:
        raise PeerLost(f"the {other} came but did not start{heard if heard.refused else ''}")
    raise PeerLost(
        f"the {other} did not come within {scenario.link.start_timeout_s:g} s "
        f"at {scenario.link.endpoint}{heard}"
    )


def _nothing() -> None:
    """Stands in for a method that a link does not have."""


def _what_runs(scenario: Scenario) -> dict[str, Any]:
    """The values of ``_MUST_FIT``."""
    return {
        "version": TABLE_VERSION,
        "table": table_hash(),
        "T_s": scenario.T_s,
        "laws": scenario.laws_digest(),
        "digest": scenario.digest(),
    }


def _boot() -> str:
    try:
        return _BOOT.read_text("ascii").strip()
    except OSError:
        return ""


def _tick(message: bytes, scenario: Scenario) -> int | None:
    """The tick of a plant's frame that a controller would accept as its first; None otherwise."""
    try:
        return FrameReader.of("controller", scenario).unpack(message, np.empty(NY))
    except FrameError:
        return None


def _read(message: bytes) -> _Hello | _Go | None:
    """The greeting in a message; None if the message does not begin as a greeting.

    Raises:
        _Refused: it begins as one and is malformed.
    """
    if message[: len(_PREFIX)] != _PREFIX[: len(message)]:
        return None
    try:
        if len(message) > LONGEST:
            raise _Refused(f"it has {len(message)} bytes, at most {LONGEST} are allowed")
        return _GREETING.validate_json(message[len(_PREFIX) :])
    except ValidationError as problem:
        raise _Refused(lines(problem)[0]) from None


def _check_time(t0: int, begin: int, now: int) -> None:
    """Check that tick 0 is neither before this side's greeting nor far away.

    Raises:
        _Refused: it is.
    """
    if not begin <= t0 <= now + _MOST_LEAD_NS:
        most = _MOST_LEAD_NS * 1e-9
        raise _Refused(
            f"t0 = {t0} lies {(t0 - now) * 1e-9:.3g} s ahead: must be at most {most:g} s ahead, "
            "and not before this side began to wait"
        )


def _compare(mine: dict[str, Any], theirs: _Hello) -> None:
    if theirs.side == mine["side"]:
        raise PeerLost(f"the other side is a {theirs.side} too")
    for what, name in _MUST_FIT.items():
        value = getattr(theirs, what)
        if value != mine[what]:
            values = f"{value!a}, ours is {mine[what]!a}"
            raise PeerLost(f"the {theirs.side} runs another {name} ({values})")
