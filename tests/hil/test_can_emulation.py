"""A virtual bus as late as a real one: who goes first, and when each is through."""

from __future__ import annotations

import can
import pytest

from gfm_hil.links.can.emulation import EmulatedBus
from gfm_hil.links.can.frame_time import classic_time, fd_time

BITRATE = 1_000_000
FRAME = classic_time(8, BITRATE)


class World:
    """A node of a bus that takes no time, and a clock that is set by hand."""

    def __init__(self, fd: bool = False) -> None:
        self.now = 100.0
        self.arriving: list[can.Message] = []
        self.node = EmulatedBus(self, fd, BITRATE, 8 * BITRATE, clock=lambda: self.now)

    def send(self, message: can.Message) -> None:
        pass

    def recv(self, timeout: float) -> can.Message | None:
        return self.arriving.pop(0) if self.arriving else None

    def arrive(self, *numbers: int, length: int = 8) -> None:
        """Frames of other nodes."""
        self.arriving += [message(number, length) for number in numbers]
        assert self.node.recv(0) is None

    def heard_at(self, after: float) -> list[int]:
        """What has come through that long after the start."""
        self.now = 100.0 + after
        out = []
        while (found := self.node.recv(0)) is not None:
            out.append(found.arbitration_id)
        return out


def message(number: int, length: int = 8) -> can.Message:
    return can.Message(
        arbitration_id=number, is_extended_id=False, data=bytes(length), is_fd=length > 8
    )


def test_a_frame_takes_its_time():
    world = World()
    world.arrive(5)
    assert world.heard_at(0.999 * FRAME) == []
    assert world.heard_at(1.001 * FRAME) == [5]


def test_a_frame_of_can_fd_takes_its_own():
    world = World(fd=True)
    world.arrive(5, length=12)
    time = fd_time(12, BITRATE, 8 * BITRATE)
    assert world.heard_at(0.999 * time) == []
    assert world.heard_at(1.001 * time) == [5]


def test_ours_keeps_others_waiting():
    world = World()
    world.node.send(message(900))
    world.now += 0.5 * FRAME
    world.arrive(5)
    assert world.heard_at(1.999 * FRAME) == []
    assert world.heard_at(2.001 * FRAME) == [5]


def test_the_lowest_of_those_that_wait_goes_next():
    world = World()
    world.arrive(700)  # has the bus
    world.now += 0.1 * FRAME
    world.arrive(300)
    world.now += 0.1 * FRAME
    world.arrive(400, 100)
    world.node.send(message(200))
    assert world.heard_at(1.001 * FRAME) == [700]
    assert world.heard_at(2.001 * FRAME) == [100]
    assert world.heard_at(3.999 * FRAME) == []  # ours
    assert world.heard_at(4.001 * FRAME) == [300]
    assert world.heard_at(5.001 * FRAME) == [400]


def test_a_bus_that_was_idle_starts_at_once():
    world = World()
    world.arrive(5)
    assert world.heard_at(10 * FRAME) == [5]
    world.arrive(6)
    assert world.heard_at(10.999 * FRAME) == []
    assert world.heard_at(11.001 * FRAME) == [6]


def test_an_error_of_the_node_itself_is_heard_at_once():
    world = World()
    world.arriving += [message(5), can.Message(is_error_frame=True, arbitration_id=0x40)]
    heard = world.node.recv(0)
    assert heard is not None and heard.is_error_frame


def test_it_waits_for_what_is_on_the_bus():
    with can.Bus(interface="virtual", channel="slow") as one:
        node = EmulatedBus(can.Bus(interface="virtual", channel="slow"), False, 10_000, 0)
        one.send(message(5))
        assert node.recv(0.001) is None  # 13 ms
        found = node.recv(5.0)
        assert found is not None and found.arbitration_id == 5
        assert node.recv(0.001) is None
        node.shutdown()


@pytest.mark.parametrize("length", [0, 3, 8])
def test_shorter_frames_take_less(length):
    world = World()
    world.arrive(5, length=length)
    assert world.heard_at(1.001 * classic_time(length, BITRATE)) == [5]
