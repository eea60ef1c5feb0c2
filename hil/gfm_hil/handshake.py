"""The start: both sides show what they are about to run, and refuse what does not fit.

Plant: HELLO every 100 ms until answered. Controller: HELLO back. Plant: START with the time of
tick 0. Messages are JSON; frames begin only after START.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from gfm_hil.errors import PeerLost
from gfm_hil.links import Link
from gfm_hil.links.base import Side
from gfm_hil.scenario import Scenario
from gfm_hil.waiting import await_message
from gfm_runtime.signals import TABLE_VERSION

_PREFIX = b"GFMHIL "
_REPEAT_NS = 100_000_000

Notice = Callable[[str], None]


def shake_hands(
    side: Side, link: Link, scenario: Scenario, stopped: Callable[[], bool], notice: Notice
) -> int:
    """Meet the other side; returns the time of tick 0 (CLOCK_MONOTONIC of the plant, ns).

    ``notice`` is told, within a second and then every five, that the other side is awaited.

    Raises:
        PeerLost: nobody came within ``link.start_timeout_s``, or they run something else.
    """
    mine = {"side": side, "table": TABLE_VERSION, "digest": scenario.digest()}
    begin = time.monotonic_ns()
    deadline = begin + int(scenario.link.start_timeout_s * 1e9)
    say_at = begin + 500_000_000
    other = "plant" if side == "controller" else "controller"
    met = False
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
                if not met:  # from here on it is there, so that silence means what it always does
                    met, deadline = True, now + int(scenario.link.peer_timeout_s * 1e9)
                if side == "plant":
                    start = now + 20_000_000
                    go: dict[str, Any] = {"kind": "start", "t0": start}
                    link.send(_PREFIX + json.dumps(go).encode())
                    return start
            elif content["kind"] == "start":
                return int(content["t0"])
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


def _read(message: bytes) -> dict[str, Any]:
    try:
        content = json.loads(message[len(_PREFIX) :])
        expected = {"hello": ("side", "table", "digest"), "start": ("t0",)}[content["kind"]]
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
