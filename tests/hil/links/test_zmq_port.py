"""ZeroMQ called from compiled code: the same messages as with pyzmq, byte by byte."""

import contextlib
import subprocess
import sys
import time

import pytest

from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.links.zeromq.options import ZmqOptions


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
