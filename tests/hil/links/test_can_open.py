"""Buses and files that a CAN link accepts, its errors for others, and our loopback bus."""

import time
from pathlib import Path

import can
import pytest

from gfm_hil.core.errors import UserError
from gfm_hil.links import link_kind, open_link
from gfm_hil.links.can.dbc import write_dbc
from gfm_hil.links.can.loopback import LoopbackBus


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return link_kind("can").fresh(tmp_path)


@pytest.mark.parametrize(
    ("endpoint", "options", "fault"),
    [
        ("can+udp://127.0.0.1:80", {}, r"endpoint = 'can\+udp://127.0.0.1:80': must be can://"),
        ("can+udp://192.168.0.1:5000", {}, r"must be can://channel"),
        ("can://", {}, "must be can://channel"),
        ("can://can0", {"interface": "pigeon"}, "cannot be opened: .*pigeon"),
        ("can:///dev/ttyX", {"interface": "slcan"}, "'can:///dev/ttyX': cannot be opened: "),
        ("can://nocan", {}, "'can://nocan': cannot be opened: "),
        ("can://x", {"bitrate": 5}, "bitrate"),
        ("can://x", {"dbc": "nowhere.dbc"}, "dbc = 'nowhere.dbc': No such file"),
        ("can://x", {"dbc": __file__}, "dbc = .*test_can_open.py': "),
    ],
)
def test_what_is_not_to_be_had_is_said(endpoint, options, fault):
    with pytest.raises(UserError, match=fault):
        open_link("can", "plant", endpoint, options)


@pytest.mark.parametrize("interface", ["pcan", "socketcan"])
def test_an_interface_that_would_not_be_used_is_refused(interface, make, endpoint):
    link = {"type": "can", "options": {"interface": interface}}
    said = rf"options\.interface = '{interface}' with %s, which is the loopback bus: set "
    with pytest.raises(UserError, match=said % "no endpoint"):
        make(link=link)
    with pytest.raises(UserError, match=said % "endpoint = 'can.*'"):
        make(link={**link, "endpoint": endpoint})
    make(link={**link, "endpoint": "can://can0"})


def test_a_dbc_of_the_other_kind_of_bus(tmp_path, endpoint):
    classic = tmp_path / "classic.dbc"
    classic.write_text(write_dbc(False))
    with pytest.raises(UserError, match=r"describes classic CAN; link\.options\.fd must agree"):
        open_link("can", "plant", endpoint, {"dbc": str(classic)})


def test_an_endpoint_that_is_taken(endpoint):
    with (
        LoopbackBus(endpoint.partition("://")[2], 1),
        pytest.raises(UserError, match="cannot be opened: occupied"),
    ):
        open_link("can", "plant", endpoint)


def test_the_loopback_bus_is_a_backend_of_python_can(endpoint):
    channel = endpoint.partition("://")[2]
    nodes = [can.Bus(interface="gfmhil-udp", channel=channel) for _ in range(4)]
    try:
        with pytest.raises(can.CanInitializationError, match="occupied"):
            can.Bus(interface="gfmhil-udp", channel=channel)
        sent = can.Message(
            arbitration_id=0x12345678, is_fd=True, bitrate_switch=True, data=bytes(range(64))
        )
        nodes[2].send(sent)
        for k in (0, 1, 3):
            heard = nodes[k].recv(5)
            assert heard is not None
            assert heard.equals(sent, timestamp_delta=None)
        assert nodes[2].recv(0) is None
        nodes[0].send(can.Message(arbitration_id=5, is_remote_frame=True, is_extended_id=False))
        assert nodes[1].recv(5).is_remote_frame
    finally:
        for node in nodes:
            node.shutdown()


def test_a_place_found_empty_is_asked_again(endpoint):
    channel = endpoint.partition("://")[2]
    with LoopbackBus(channel, 0) as one:
        ping = can.Message(arbitration_id=1)
        for _ in range(3):
            one.send(ping)
        with LoopbackBus(channel, 1) as other:
            until = time.monotonic() + 5
            while other.recv(0.02) is None:
                assert time.monotonic() < until
                one.send(ping)
