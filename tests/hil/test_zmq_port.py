"""ZeroMQ called from compiled code: the same messages as with pyzmq, byte by byte."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numba import njit, types

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.links import Link
from gfm_hil.links.port import PORT_CALL
from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.links.zeromq.options import ZmqOptions

from ..support.laws import home_plant
from ..support.links import PATIENT, RIG, assert_same, deliver, run_pair

_FUNCTION = types.FunctionType(PORT_CALL)


@njit(types.int64(_FUNCTION, types.int64[::1], types.uint8[::1]), nogil=True)
def compiled(function, handle, message):
    return function(handle, message)


class ByPort:
    """A link that sends and receives through its port."""

    def __init__(self, link: Link, size: int = 512) -> None:
        assert link.port is not None
        self._link, self._port, self._room = link, link.port, np.zeros(size, np.uint8)

    def send(self, message: bytes) -> bool:
        content = np.frombuffer(bytearray(message), np.uint8)
        return bool(compiled(self._port.send, self._port.handle, content))

    def receive(self) -> bytes | None:
        size = compiled(self._port.receive, self._port.handle, self._room)
        return self._room[:size].tobytes() if size else None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


@pytest.fixture
def ends(endpoint: str) -> Iterator[dict[Role, ZmqLink]]:
    """Both ends of a link that has already carried a message each way."""
    links = {role: ZmqLink(role, endpoint) for role in ROLES}
    deliver(links["plant"], b"hello")
    assert links["controller"].wait(30)
    assert links["controller"].receive() == b"hello"
    yield links
    for link in links.values():
        link.close()


@pytest.mark.parametrize("by_port", [("plant",), ("controller",), ROLES])
def test_lockstep_by_port_is_bit_for_bit_in_process(by_port, make, run, tmp_path, endpoint):
    content = {
        "law": "vsg-2",
        "duration": 0.05,
        "seed": 3,
        "link": PATIENT,
        "plant": {**RIG, **home_plant("vsg-2")},
        "events": [{"tick": 50, "type": "reference", "P_ref": 0.55}],
    }

    def touch(role: Role, link: Link) -> Any:
        return ByPort(link) if role in by_port else link

    apart = run_pair(make(**content), tmp_path, "zmq", touch=touch, endpoint=endpoint).signals
    assert np.ptp(apart["true_p"]) > 0
    assert_same(apart, run(**content).signals)


def test_messages_of_any_size_either_way_in_order(ends):
    sent = [bytes(range(k)) for k in (1, 68, 84, 255)]
    for role, other in zip(ROLES, ROLES[::-1], strict=True):
        for message in sent:
            assert ByPort(ends[role]).send(message)
        for k, message in enumerate(sent):  # alternately through port and pyzmq
            link = ByPort(ends[other]) if k % 2 else ends[other]
            assert ends[other].wait(30)
            assert link.receive() == message
        assert ByPort(ends[other]).receive() is None


def test_a_message_that_is_too_long_is_gone_and_tells_its_length(ends):
    deliver(ends["plant"], b"x" * 100)
    deliver(ends["plant"], b"next")
    assert ends["controller"].wait(30)
    room, port = np.zeros(84, np.uint8), ends["controller"].port
    assert compiled(port.receive, port.handle, room) == 100
    assert room.tobytes() == b"x" * 84
    assert ends["controller"].wait(30)
    assert ByPort(ends["controller"]).receive() == b"next"


def test_the_patient_way_to_receive_sleeps_but_not_for_ever(ends):
    port, room = ends["controller"].port, np.zeros(84, np.uint8)
    assert compiled(port.patient, port.handle, room) == 0
    deliver(ends["plant"], b"late")
    while (size := compiled(port.patient, port.handle, room)) == 0:
        pass
    assert room[:size].tobytes() == b"late"


def test_a_port_with_nobody_there_drops_and_one_that_is_closed_does_nothing(endpoint, opened):
    link = opened(ZmqLink("plant", endpoint))
    by_port = ByPort(link)
    assert not all([by_port.send(b"x" * 60) for _ in range(1000)])
    assert by_port.receive() is None
    assert not by_port.send(b"x")
    assert by_port.receive() is None


def test_portable_leaves_the_frames_to_pyzmq(endpoint):
    link = ZmqLink("plant", endpoint, ZmqOptions(portable=True))
    link.close()
    assert link.port is None


@pytest.mark.parametrize("missing", ["zmq.backend.cython", "ctypes"])
def test_without_a_libzmq_to_call_it_says_so_and_goes_on(missing, endpoint):
    """As with PyPy, or a pyzmq whose extension hides the library linked into it."""
    hide = {
        "zmq.backend.cython": "import sys; sys.modules['zmq.backend.cython'] = None",
        "ctypes": "import ctypes; ctypes.CDLL = lambda path: object()",
    }[missing]
    program = f"""
import zmq
from gfm_hil.links import open_link
{hide}
ends = [open_link("zmq", side, {endpoint!r}) for side in ("controller", "plant")]
assert ends[0].port is None
ends[1].send(b"frame")
assert ends[0].wait(30) and ends[0].receive() == b"frame"
for end in ends:
    end.close()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "frames go by pyzmq" in done.stderr


def test_a_plant_that_was_turned_away_reaches_the_controller_when_the_other_has_left(endpoint):
    """As when a new run starts while the previous run's plant still waits for its peer."""
    with contextlib.ExitStack() as stack:
        controller, old = ZmqLink("controller", endpoint), ZmqLink("plant", endpoint)
        stack.callback(controller.close)
        old.send(b"old")
        assert controller.wait(30)
        assert controller.receive() == b"old"
        new = ZmqLink("plant", endpoint)
        stack.callback(new.close)
        time.sleep(0.1)  # until it is refused
        old.close()
        until = time.monotonic() + 60
        while controller.receive() != b"new":
            assert time.monotonic() < until
            new.again()
            new.wait(0.2)
            new.send(b"new")
            controller.wait(0.2)
