"""Both sides over a real ZeroMQ link, in two threads of this process."""

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import Link
from gfm_hil.links.frame import FrameReader, FrameWriter, frame_dtype
from gfm_hil.links.zeromq.link import ZmqLink
from gfm_hil.recording.log import Outcome, read_log, worst
from gfm_runtime.states import PLANT_TRIP, REASONS, RUNNING

from ...support.links import PATIENT, Tampering, run_pair


def test_a_link_that_falls_silent_ends_the_run(make, tmp_path, endpoint):
    def touch(role: Role, link: Link) -> Any:
        return Tampering(link, lambda k, m: None if k >= 20 else m) if role == "plant" else link

    scenario = make(link={**PATIENT, "peer_timeout_s": 1.0})
    signals = run_pair(scenario, tmp_path, "zmq", touch=touch, endpoint=endpoint).signals
    outcome = worst(read_log(*sorted(tmp_path.glob("events_*.jsonl"))), None)
    assert outcome.status == "safe"
    assert "gone" in outcome.reason
    # the plant may have repeated a frame, or still receive the controller's last frame
    assert 1 <= len(signals["tick"]) <= 21


def test_the_plant_s_own_reason_goes_before_what_the_controller_saw_of_it():
    seen = {"event": "end", "status": "tripped", "reason": REASONS[PLANT_TRIP], "tick": 9}
    own = {"event": "end", "status": "safe", "reason": "no fresh u", "tick": 8}
    assert worst([own, seen], None) == Outcome("safe", "no fresh u", 8)
    done = {"event": "end", "status": "completed", "reason": "", "tick": 10}
    assert worst([done, seen], None).status == "tripped"


def test_a_damaged_command_is_refused_and_never_applied(make, tmp_path, endpoint):
    def damage(k: int, message: bytes) -> bytes:
        tick = np.frombuffer(message, frame_dtype("u"))["tick"][0]  # not k: a slow plant repeats
        flipped = bytes(255 - one for one in message[30:32])  # in the mantissa of omega_u
        return message if tick < 20 else message[:30] + flipped + message[32:]

    def touch(role: Role, link: Link) -> Any:
        return Tampering(link, damage) if role == "controller" else link

    scenario = make(link={**PATIENT, "peer_timeout_s": 1.0})
    signals = run_pair(scenario, tmp_path, "zmq", touch=touch, endpoint=endpoint).signals
    assert worst(read_log(*sorted(tmp_path.glob("events_*.jsonl"))), None).status == "safe"
    assert len(signals["tick"]) in (20, 21)  # with tick 20 if the controller's last frame came
    assert np.ptp(signals["u_omega_u"]) <= 1e-9


def test_an_ipc_endpoint_that_lives_is_not_taken_over(endpoint, opened):
    first = opened(ZmqLink("controller", endpoint))
    plant = opened(ZmqLink("plant", endpoint))
    with pytest.raises(UserError, match="occupied"):
        ZmqLink("controller", endpoint)
    plant.send(FrameWriter("y").pack(0, RUNNING, 0, np.ones(5)))
    assert first.wait(30)
    assert FrameReader("y").unpack(first.receive(), np.zeros(5)) == 0  # it still works


def test_an_ipc_endpoint_that_a_killed_run_left_is_used_again(endpoint):
    path = endpoint.removeprefix("ipc://")
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(path)
    assert Path(path).exists()
    ZmqLink("controller", endpoint).close()


@pytest.mark.timeout(30)
def test_a_plant_whose_controller_never_comes_ends():
    """What it sent before it tried anew would wait for ever to be sent."""
    link = ZmqLink("plant", "tcp://127.0.0.1:1")
    assert link.send(b"frame")
    link.again()
    link.close()


@pytest.mark.parametrize("endpoint", ["udp://127.0.0.1:1", "", "tcp://nowhere"])
def test_an_endpoint_that_is_none(endpoint):
    with pytest.raises(UserError, match=r"link\.endpoint = "):
        ZmqLink("controller", endpoint)
