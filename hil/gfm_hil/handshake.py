"""The start: both sides show what they are about to run, and refuse what does not fit.

Plant: HELLO every 100 ms until answered. Controller: HELLO back. Plant: START with the time of
tick 0. Messages are JSON; frames begin only after START.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gfm_hil.errors import PeerLost
from gfm_hil.links import Link
from gfm_hil.links.base import Side
from gfm_hil.scenario import Scenario
from gfm_hil.waiting import await_message
from gfm_runtime.signals import TABLE_VERSION

_PREFIX = b"GFMHIL "
_REPEAT_NS = 100_000_000
_LEAD_NS = 20_000_000  # from START to tick 0
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # of Linux; CLOCK_MONOTONIC counts from that boot

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
    mine = {"side": side, "table": TABLE_VERSION, "digest": scenario.digest(), "boot": boot}
    begin = time.monotonic_ns()
    deadline = begin + int(scenario.link.start_timeout_s * 1e9)
    say_at = begin + 500_000_000
    other = "plant" if side == "controller" else "controller"
    met = one_clock = False
    while not stopped():
        if side == "plant":
            link.send(_PREFIX + json.dumps({**mine, "kind": "hello"}).encode())
        message = await_message(link, min(time.monotonic_ns() + _REPEAT_NS, deadline), stopped)
        now = time.monotonic_ns()
        if message is not None and message.startswith(_PREFIX):
            content = _read(message)
            if content["kind"] == "hello":
                if side == "controller" and not met:  # answer first: both shall see a misfit
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
            elif content["kind"] == "start":
                return Start(int(content["t0"]) if one_clock else now + _LEAD_NS, one_clock)
        if now >= deadline:
            break
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


def _boot() -> str:
    try:
        return _BOOT.read_text("ascii").strip()
    except OSError:
        return ""


def _read(message: bytes) -> dict[str, Any]:
    try:
        content = json.loads(message[len(_PREFIX) :])
        expected = {"hello": ("side", "table", "digest", "boot"), "start": ("t0",)}[content["kind"]]
        return {"kind": content["kind"], **{key: content[key] for key in expected}}
    except (ValueError, KeyError, TypeError):
        raise PeerLost(f"the other side speaks another language: {message[:60]!r}") from None


def _compare(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    if theirs["side"] == mine["side"]:
        raise PeerLost(f"the other side is a {theirs['side']} too")
    for what in ("table", "digest"):
        if theirs[what] != mine[what]:
            name = "signal table" if what == "table" else "scenario or law file"
            raise PeerLost(f"the {theirs['side']} runs another {name} ({theirs[what]})")
