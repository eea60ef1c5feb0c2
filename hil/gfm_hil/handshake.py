"""The start: both sides show what they are about to run, and refuse what does not fit.

Plant: HELLO every 100 ms until answered. Controller: HELLO back. Plant: START with the time of
tick 0. Messages are JSON; frames begin only after START. START is said once: where a link has lost
it, the plant's first frame that gets through says when tick 0 was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.errors import PeerLost
from gfm_hil.frames import FrameError, FrameReader
from gfm_hil.links import Link
from gfm_hil.links.base import Side
from gfm_hil.scenario import Scenario
from gfm_hil.waiting import await_message
from gfm_runtime.signals import NY, TABLE_VERSION, table_hash

_PREFIX = b"GFMHIL "
_REPEAT_NS = 100_000_000
_AGAIN_NS = 2_000_000_000  # after which a link that knows how reaches out anew
_LEAD_NS = 20_000_000  # from START to tick 0
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # of Linux; CLOCK_MONOTONIC counts from that boot

#: what both sides must have in common, in the order of looking, and its name in words
_MUST_FIT = {
    "version": "version of the signal table",
    "table": "signal table",
    "T_s": "sampling time T_s",
    "laws": "law or law file",
    "digest": "scenario",
}

Notice = Callable[[str], None]


@dataclass(frozen=True)
class Start:
    """What both sides agreed on.

    Attributes:
        t0_ns: time of tick 0 by our own CLOCK_MONOTONIC; where the other side has another one,
            the controller's is late by the time that START took to come.
        one_clock: both sides run on one machine.
    """

    t0_ns: int
    one_clock: bool


def shake_hands(
    side: Side, link: Link, scenario: Scenario, stopped: Callable[[], bool], notice: Notice
) -> Start:
    """Meet the other side and agree on the time of tick 0.

    ``notice`` is told, within a second and then every five, that the other side is awaited.

    Raises:
        PeerLost: nobody came within ``link.start_timeout_s``, or they run something else.
    """
    boot = _boot()
    mine = {"side": side, "boot": boot, **_what_runs(scenario)}
    begin = time.monotonic_ns()
    deadline = begin + int(scenario.link.start_timeout_s * 1e9)
    say_at, again_at = begin + 500_000_000, begin + _AGAIN_NS
    other = "plant" if side == "controller" else "controller"
    met = one_clock = False
    answered = -_REPEAT_NS
    while not stopped():
        if side == "plant":
            link.send(_PREFIX + json.dumps({**mine, "kind": "hello"}).encode())
        message = await_message(link, min(time.monotonic_ns() + _REPEAT_NS, deadline), stopped)
        now = time.monotonic_ns()
        if message is not None and message.startswith(_PREFIX):
            content = _read(message)
            if content["kind"] == "hello":
                # answer first: both shall see a misfit; and once for all that had piled up
                if side == "controller" and now - answered >= _REPEAT_NS:
                    answered = now
                    link.send(_PREFIX + json.dumps({**mine, "kind": "hello"}).encode())
                _compare(mine, content)
                one_clock = bool(boot) and content["boot"] == boot
                if not met:  # from here on it is there, so that silence means what it always does
                    met, deadline = True, now + int(scenario.link.peer_timeout_s * 1e9)
                if side == "plant":
                    start = now + _LEAD_NS
                    go: dict[str, Any] = {"kind": "start", "t0": start}
                    link.send(_PREFIX + json.dumps(go).encode())
                    return Start(start, one_clock)
            elif met:
                return Start(content["t0"] if one_clock else now + _LEAD_NS, one_clock)
        elif message is not None and met:
            tick = _tick(message, scenario)
            if tick is not None:  # it runs: START was lost
                return Start(now - round(tick * scenario.T_s * 1e9), one_clock)
        if now >= deadline:
            break
        if now >= again_at and not met:
            getattr(link, "again", _nothing)()
            again_at = now + _AGAIN_NS
        if now >= say_at and not met:
            notice(f"waiting for the {other} at {scenario.link.endpoint} …")
            say_at = now + 5_000_000_000
    if stopped():
        raise PeerLost(f"interrupted while waiting for the {other}")
    if met:
        raise PeerLost(f"the {other} came but did not start")
    raise PeerLost(
        f"the {other} did not come within {scenario.link.start_timeout_s:g} s "
        f"at {scenario.link.endpoint}"
    )


def _nothing() -> None:
    """Of a link that has no second way."""


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


def _read(message: bytes) -> dict[str, Any]:
    try:
        content = json.loads(message[len(_PREFIX) :])
        expected = {"hello": ("side", "boot", *_MUST_FIT), "start": ("t0",)}[content["kind"]]
        found = {"kind": content["kind"], **{key: content[key] for key in expected}}
        return found if content["kind"] == "hello" else {**found, "t0": int(content["t0"])}
    except (ValueError, KeyError, TypeError):
        raise PeerLost(f"the other side speaks another language: {message[:60]!r}") from None


def _compare(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    if theirs["side"] == mine["side"]:
        raise PeerLost(f"the other side is a {theirs['side']} too")
    for what, name in _MUST_FIT.items():
        if theirs[what] != mine[what]:
            values = f"{theirs[what]}, ours is {mine[what]}"
            raise PeerLost(f"the {theirs['side']} runs another {name} ({values})")
