"""Messages in place of a greeting: refused with a notice and counted, and the wait continues."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine import handshake
from gfm_hil.engine.handshake import Start, shake_hands
from gfm_hil.links import Link, open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameWriter
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import NY

from ...support.links import PATIENT
from ...support.processes import free_port
from ...support.shm import endpoint as shm_endpoint

pytestmark = pytest.mark.processes

__all__ = ["shm_endpoint"]

SHORT = {**PATIENT, "start_timeout_s": 0.3}
DAY_NS = 86_400_000_000_000
Ends = dict[Role, Link]


@pytest.fixture(params=["zmq", "shm"])
def ends(request, endpoint, shm_endpoint) -> Iterator[Ends]:
    where = endpoint if request.param == "zmq" else shm_endpoint
    links: Ends = {role: open_link(request.param, role, where) for role in ROLES}
    yield links
    for role in reversed(ROLES):
        links[role].close()


def hello(scenario: Scenario, **other: Any) -> bytes:
    """The plant's greeting, with the given changes."""
    said = {"kind": "hello", "role": "plant", "boot": handshake._boot()}
    return b"GFMHIL " + json.dumps({**said, **handshake._what_runs(scenario), **other}).encode()


def start(t0: str) -> bytes:
    return f'GFMHIL {{"kind": "start", "t0": {t0}}}'.encode()


def greet(link: Link, scenario: Scenario, notice: Callable[[str], None] = print) -> Start:
    """Shake hands as a controller."""
    return shake_hands("controller", link, scenario, lambda: False, notice)


NO_GREETINGS = {
    "{}": "kind: missing",
    "nonsense": "Invalid JSON",
    '{"kind": "start"}': "start.t0: missing",
    "[]": "must be an object",
    "[" * 400: "recursion limit",
    '{"kind": "hello", "si': "Invalid JSON: EOF",
    '{"kind": "hello", "role": "plant", "boot": 1}': "hello.boot: must be a valid string",
    '{"kind": "\\u001b[2J"}': r"kind = '\x1b[2J': must be one of ['hello', 'start']",
    "\x1b[2J\udcff": r"not b'\x1b[2J\xff'",
    start("1e999")[7:].decode(): "start.t0: must be a valid integer, not inf",
    start("1" + 40 * "0")[7:].decode(): "start.t0: must be less than 9223372036854775808",
}


#: all over one link, which does not read them, and one over the other
OVER = [("shm", *one) for one in NO_GREETINGS.items()] + [("zmq", "{}", NO_GREETINGS["{}"])]


@pytest.mark.parametrize(("ends", "said", "why"), OVER, indirect=["ends"], ids=range(len(OVER)))
@pytest.mark.attack(
    "5.1",
    "a greeting that is deep JSON, cut off, of wrong types, with escapes, or t0 = 1e999 or 10⁴⁰",
    "a traceback (RecursionError, OverflowError), or the end of the wait",
)
def test_it_is_refused_in_words_and_the_plant_is_waited_for(said, why, ends, make, attack_now):
    scenario, frames = make(link=PATIENT), FrameWriter("y")
    no_greeting = b"GFMHIL " + said.encode(errors="surrogateescape")
    assert len(no_greeting) <= LONGEST
    for message in (no_greeting, hello(scenario), no_greeting, frames.pack(0, 0, 0, np.ones(NY))):
        assert ends["plant"].send(message)
    assert greet(ends["controller"], scenario).refused == 2
    assert ends["plant"].send(no_greeting)
    with pytest.raises(PeerLost, match=r"the plant did not come within 0\.3 s") as found:
        greet(ends["controller"], make(link=SHORT))
    text = str(found.value)
    assert "; greetings refused: 1, the last one because " in text
    assert why in text
    assert text.isprintable()
    assert len(text) < 400
    attack_now(f"all {len(NO_GREETINGS)} refused in words and counted; a good greeting then starts")


@pytest.mark.parametrize("t0", [0, DAY_NS * 27 // 24, -1])
@pytest.mark.attack(
    "5.2", "START with a tick 0 that is 27 h ahead, or long ago", "the controller took it"
)
def test_a_start_at_an_impossible_time_is_refused(t0, ends, make, attack_now):
    scenario = make(link={**PATIENT, "peer_timeout_s": 0.15})
    ahead = time.monotonic_ns() + t0 if t0 > 0 else t0
    for message in (hello(scenario), start(str(ahead))):
        assert ends["plant"].send(message)
    with pytest.raises(PeerLost, match=r"came but did not start; .* refused: 1, .*t0"):
        greet(ends["controller"], scenario)
    attack_now("refused: at most 10 s ahead, and not before this side began to wait")


@pytest.mark.attack(
    "5.3", "terminal escapes in the plant's digest of its scenario", "they were printed as they are"
)
def test_what_a_peer_said_is_shown_escaped(ends, make, attack_now):
    scenario = make(link=PATIENT)
    assert ends["plant"].send(hello(scenario, digest="\x1b[2J\x1b]0;owned\x07\u202e"))
    with pytest.raises(PeerLost, match="the plant runs another scenario") as found:
        greet(ends["controller"], scenario)
    assert str(found.value).isprintable()
    assert r"'\x1b[2J\x1b]0;owned\x07\u202e'" in str(found.value)
    attack_now("shown as Python writes it, in ASCII; at most 100 characters are taken")


@pytest.mark.attack("5.4", "a greeting of more than 504 bytes", "it was read, however long")
def test_a_long_greeting_is_refused_before_it_is_read(make, attack_now):
    """Over CAN, where a message may have 15 kB; other links do not carry such a message."""
    with pytest.raises(handshake._Refused, match="it has 521 bytes, at most 504 are allowed"):
        handshake._read(hello(make(), boot="x" * 300).ljust(521))
    attack_now(f"refused above {LONGEST} bytes")


@pytest.mark.parametrize("name", ["", " x", "x" * 65, "\x1b[2J", "x\n", "\u202ex"])
def test_a_controller_whose_name_cannot_be_printed_is_refused(name, make):
    with pytest.raises(handshake._Refused, match=r"hello\.name: must match pattern"):
        handshake._read(hello(make(), role="controller", name=name))


def test_a_peer_that_says_nothing_is_told_from_none(ends, make):
    said: list[str] = []  # after half a second
    scenario = make(link={**PATIENT, "start_timeout_s": 0.8})
    ends["plant"].send(b"x")  # so that it is connected
    assert ends["controller"].wait(30)
    ends["controller"].receive()
    for role in ROLES:  # the controller first: the plant's greetings would wait for it
        with pytest.raises(PeerLost, match="; a peer is connected but says nothing"):
            shake_hands(role, ends[role], scenario, lambda: False, said.append)
    assert len(said) == 2
    assert all(text.endswith(" …; a peer is connected but says nothing") for text in said)


@pytest.mark.attack(
    "5.5",
    "a program connects to the controller's tcp port and says nothing",
    "reported as if no peer had come",
)
def test_a_silent_peer_is_told_and_leaves_its_place(make, attack_now, opened):
    """libzmq takes an HTTP client for a ZeroMQ peer of version 1, as long as it is connected."""
    port = free_port()
    where = f"tcp://127.0.0.1:{port}"
    controller, scenario = opened(open_link("zmq", "controller", where)), make(link=PATIENT)
    with socket.create_connection(("127.0.0.1", port)) as scanner:
        scanner.sendall(b"GET / HTTP/1.1\r\n\r\n")
        with pytest.raises(PeerLost, match=r"; a peer is connected but says nothing$"):
            greet(controller, make(link=SHORT))
    while controller.connected():
        time.sleep(0.01)
    plant = open_link("zmq", "plant", where)
    for message in (hello(scenario), FrameWriter("y").pack(0, 0, 0, np.ones(NY))):
        assert plant.send(message)
    assert greet(controller, scenario).refused == 0
    plant.close()
    attack_now("named as a peer that says nothing; once it has left the plant gets in")


def test_other_messages_are_counted(ends, make):
    ends["plant"].send(b"hello?")
    with pytest.raises(PeerLost, match=r"; messages that are no greeting: 1$"):
        greet(ends["controller"], make(link=SHORT))
