"""The start: each side says what it is about to run, and refuses a peer that runs something else.

The plant sends HELLO every 100 ms until the controller answers with a HELLO of its own. Then, or
when all its controllers have answered, the plant sends START with the time of tick 0. Messages are
JSON, and frames begin only after START. The plant sends START once: if the link loses it, the
controller takes the time of tick 0 from the plant's first frame.

The plant's HELLO carries a number that it draws for this run, by which the recordings of both sides
are put together later. The controller's HELLO may carry a name, so that a report can say who
controlled.

A side refuses and counts a malformed greeting, and goes on waiting. It shows a peer's text only
escaped and cut.
"""

import json
import os
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from gfm_hil.core.errors import PeerLost, lines
from gfm_hil.core.roles import OTHER, OUR_CONTROLLER, Role
from gfm_hil.engine.loop_records import limited_reader
from gfm_hil.links import Link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameError
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import TABLE_VERSION, carried, table_hash

_PREFIX = b"GFMHIL "
_SPIN_NS = 50_000  # longer would starve the threads that bring the answer
_REPEAT_NS = 100_000_000
_AGAIN_NS = 2_000_000_000  # after which a link that knows how reaches out anew
_LEAD_NS = 20_000_000  # from START to tick 0
_LEAD_OF_SEVERAL_NS = 3 * _REPEAT_NS  # where START waits for a repetition
_MOST_LEAD_NS = 10_000_000_000  # of a plant that is not ours
_BOOT = Path("/proc/sys/kernel/random/boot_id")  # of Linux; CLOCK_MONOTONIC counts from that boot

#: what both sides must have in common, in the order of comparison, and its name in words
_MUST_FIT = {
    "version": "version of the signal table",
    "table": "signal table",
    "T_s": "sampling time T_s",
    "laws": "law or law file",
    "digest": "scenario",
}

_Text = Annotated[str, Field(max_length=100)]
_Name = Annotated[str, Field(pattern="^[!-~]([ -~]{0,62}[!-~])?$")]  # printable ASCII
_RunId = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class _Greeting(BaseModel):
    """A foreign controller may send more fields than these; this side ignores them."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, allow_inf_nan=False)


class _Hello(_Greeting):
    kind: Literal["hello"]
    role: Role
    boot: _Text
    version: int = Field(ge=0, lt=2**31)
    table: _Text
    T_s: float = Field(gt=0.0)
    laws: _Text
    digest: _Text
    run: _RunId | None = None  # of the plant
    name: _Name | None = None  # of the controller


class _Go(_Greeting):
    kind: Literal["start"]
    t0: int = Field(ge=0, lt=2**63)  # ns of the plant's CLOCK_MONOTONIC


_GREETING: TypeAdapter[_Hello | _Go] = TypeAdapter(
    Annotated[_Hello | _Go, Field(discriminator="kind")]
)


@dataclass(frozen=True)
class Start:
    """What both sides agreed on."""

    # time of tick 0 by our own CLOCK_MONOTONIC; where the other side has another one, the
    # controller's is late by the time that START took to come
    t0_ns: int
    one_clock: bool  # both sides run on one machine
    refused: int  # how many malformed greetings came
    # the number that the plant has drawn for this run, 16 hexadecimal digits; None if a foreign
    # plant sent none
    run: str | None
    controller: str | None  # what the controller calls itself; None if it did not say


class Meeting:
    """Of a plant with several controllers: they begin together, when the last one has come.

    Args:
        controllers: how many there are.
    """

    def __init__(self, controllers: int = 1) -> None:
        self.run = secrets.token_hex(8)
        self._missing, self._t0_ns = controllers, 0
        self._lead_ns = _LEAD_NS if controllers == 1 else _LEAD_OF_SEVERAL_NS
        self._lock = threading.Lock()

    def arrived(self) -> None:
        """Count one more controller."""
        with self._lock:
            self._missing -= 1
            if self._missing == 0:
                self._t0_ns = time.monotonic_ns() + self._lead_ns

    @property
    def t0_ns(self) -> int:
        """Time of tick 0; 0 while one is missing."""
        return self._t0_ns


class _Refused(Exception):
    """A greeting that is malformed; says why."""


def shake_hands(
    role: Role,
    link: Link,
    scenario: Scenario,
    stopped: Callable[[], bool],
    notice: Callable[[str], None],
    meeting: Meeting | None = None,
    name: str = OUR_CONTROLLER,
) -> Start:
    """Meet the other side and agree on the time of tick 0.

    Within a second and then every five, ``notice`` gets a line that the other side is awaited, and
    what came instead.

    Args:
        meeting: of a plant, in common to its controllers.
        name: what a controller calls itself.

    Raises:
        PeerLost: no good greeting came within ``link.start_timeout_s``, or the other side runs
            something else.
    """
    side = _Side(role, link, scenario, meeting or Meeting(), name)
    reconnect = getattr(link, "again", None)
    say_at, again_at = side.begin + 500_000_000, side.begin + _AGAIN_NS
    while not stopped():
        if role == "plant":
            side.send_hello()
        wait_until = min(time.monotonic_ns() + _REPEAT_NS, side.deadline)
        message = await_message(link, wait_until, stopped)
        now = time.monotonic_ns()
        start = side.take(message, now)
        if start is not None:
            return start
        if now >= side.deadline:
            break
        if now >= again_at and not side.met:
            if reconnect is not None:
                reconnect()
            again_at = now + _AGAIN_NS
        if now >= say_at and not side.met:
            notice(f"waiting for the {side.other} at {scenario.link.endpoint} …{side.heard()}")
            say_at = now + 5_000_000_000
    if stopped():
        raise PeerLost(f"interrupted while waiting for the {side.other}{side.heard()}")
    raise side.lost()


def await_message(link: Link, deadline_ns: int, stopped: Callable[[], bool]) -> bytes | None:
    """The next message, or None at the deadline (CLOCK_MONOTONIC, ns) or once ``stopped()``.

    It yields after every poll, because a pure spin would starve libzmq's own thread on two cores,
    and sleeps between two polls after 50 us.
    """
    spin_until = time.monotonic_ns() + _SPIN_NS
    while True:
        message = link.receive()
        if message is not None:
            return message
        now = time.monotonic_ns()
        if now >= deadline_ns or stopped():
            return None
        if now < spin_until:
            os.sched_yield()
        else:
            link.wait(min(0.02, (deadline_ns - now) * 1e-9))


class _Side:
    """What one side of the handshake has said, and what it has learned of the other.

    Attributes:
        other: the role of the peer.
        begin, deadline: ns; until when to wait.
        met: a HELLO came that fits ours.
    """

    def __init__(
        self, role: Role, link: Link, scenario: Scenario, meeting: Meeting, name: str
    ) -> None:
        self._role, self._link, self._scenario, self._meeting = role, link, scenario, meeting
        self.other = OTHER[role]
        own = {"run": meeting.run} if role == "plant" else {"name": name}
        self._mine = {"role": role, "boot": _boot(), **_what_runs(scenario), **own}
        self._run, self._controller = self._mine.get("run"), self._mine.get("name")
        self.begin = time.monotonic_ns()
        self.deadline = self._latest = self.begin + int(scenario.link.start_timeout_s * 1e9)
        self.met = self._one_clock = False
        self._answered = -_REPEAT_NS
        self._refused, self._others, self._why = 0, 0, ""

    def send_hello(self) -> None:
        self._send({**self._mine, "kind": "hello"})

    def _send(self, greeting: dict[str, Any]) -> None:
        self._link.send(_PREFIX + json.dumps(greeting).encode())

    def take(self, message: bytes | None, now: int) -> Start | None:
        """Process what came, if anything; returns what both sides agreed on once they have. Raises
        PeerLost: the other side runs something else."""
        try:
            greeting = None if message is None else _read(message)
            if isinstance(greeting, _Hello):
                self._meet(greeting, now)
            elif isinstance(greeting, _Go) and self.met:
                return self._start_at(greeting.t0, now)
            elif message is not None and greeting is None:
                tick = _tick(message, self._scenario) if self.met else None
                if tick is not None:  # it runs: START was lost
                    return self._agreed(now - round(tick * self._scenario.T_s * 1e9))
                self._others += 1
        except _Refused as problem:
            self._refused, self._why = self._refused + 1, str(problem)
        if self.met and self._role == "plant" and self._meeting.t0_ns:
            self._send({"kind": "start", "t0": self._meeting.t0_ns})
            return self._agreed(self._meeting.t0_ns)
        return None

    def _meet(self, hello: _Hello, now: int) -> None:
        # Answer before comparing, so that both sides see a misfit, and answer once for all the
        # greetings that had piled up.
        if self._role == "controller" and now - self._answered >= _REPEAT_NS:
            self._answered = now
            self.send_hello()
        _compare(self._mine, hello)
        self._one_clock = bool(hello.boot) and hello.boot == self._mine["boot"]
        if self._role == "controller":
            self._run = hello.run
        else:
            self._controller = hello.name
            if not self.met:
                self._meeting.arrived()
        # from here on silence means that the other side is gone
        quiet = now + int(self._scenario.peer_timeout_s * 1e9)
        self.deadline = max(self.deadline, min(quiet, self._latest)) if self.met else quiet
        self.met = True

    def _start_at(self, t0: int, now: int) -> Start:
        """Take the plant's time of tick 0. Raises _Refused: it lies before this side began to wait,
        or far ahead."""
        if not self._one_clock:
            return self._agreed(now + _LEAD_NS)
        if not self.begin <= t0 <= now + _MOST_LEAD_NS:
            raise _Refused(
                f"t0 = {t0} lies {(t0 - now) * 1e-9:.3g} s ahead: must be at most "
                f"{_MOST_LEAD_NS * 1e-9:g} s ahead, and not before this side began to wait"
            )
        return self._agreed(t0)

    def _agreed(self, t0_ns: int) -> Start:
        return Start(t0_ns, self._one_clock, self._refused, self._run, self._controller)

    def heard(self) -> str:
        """What came that is no good greeting, to append to a message."""
        if self._refused:
            return f"; greetings refused: {self._refused}, the last one because {self._why}"
        if self._others:
            return f"; messages that are no greeting: {self._others}"
        connected = getattr(self._link, "connected", None)
        silent = connected is not None and connected()
        return "; a peer is connected but says nothing" if silent else ""

    def lost(self) -> PeerLost:
        """The error at the deadline."""
        if self.met:
            heard = self.heard() if self._refused else ""
            return PeerLost(f"the {self.other} came but did not start{heard}")
        link = self._scenario.link
        return PeerLost(
            f"the {self.other} did not come within {link.start_timeout_s:g} s "
            f"at {link.endpoint}{self.heard()}"
        )


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
        return limited_reader("controller", scenario).unpack(
            message, np.empty(len(carried("y", scenario.frame_signals)))
        )
    except FrameError:
        return None


def _read(message: bytes) -> _Hello | _Go | None:
    """The greeting in a message; None if it does not begin as one. Raises _Refused: it begins as
    one, but is none."""
    if message[: len(_PREFIX)] != _PREFIX[: len(message)]:
        return None
    try:
        if len(message) > LONGEST:
            raise _Refused(f"it has {len(message)} bytes, at most {LONGEST} are allowed")
        return _GREETING.validate_json(message[len(_PREFIX) :])
    except ValidationError as problem:
        raise _Refused(lines(problem)[0]) from None


def _compare(mine: dict[str, Any], theirs: _Hello) -> None:
    if theirs.role == mine["role"]:
        raise PeerLost(f"the other side is a {theirs.role} too")
    for what, name in _MUST_FIT.items():
        value = getattr(theirs, what)
        if value != mine[what]:
            values = f"{value!a}, ours is {mine[what]!a}"
            raise PeerLost(f"the {theirs.role} runs another {name} ({values})")
