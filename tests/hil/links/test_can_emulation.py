"""A virtual bus with a real bus's delays: the order of frames, and when each is delivered."""

import time

import numpy as np
import pytest

from gfm_hil.links import link_kind, open_link
from gfm_hil.links.can import emulation
from gfm_hil.links.can.bus_time import frame_time
from gfm_hil.links.can.wire import ERROR, frame_dtype

from ...support.can import frame_of

BITRATE = 1_000_000
FRAME = frame_time(8, False, BITRATE, BITRATE)


class World:
    """A node's schedule of the bus, and a clock that the test sets."""

    def __init__(self, fd: bool = False) -> None:
        self.now = 100.0
        self.bus = np.zeros(1, emulation.bus_dtype)
        self.places = np.zeros(2 * emulation.PLACES, emulation.place_dtype)
        emulation.set_bus(self.bus, fd, BITRATE, 8 * BITRATE)

    def _ns(self) -> int:
        return round(self.now * 1e9)

    def send(self, number: int) -> None:
        """Send a frame of our own."""
        emulation.arrive(self.bus, self.places, frame_of(number, bytes(8)), 0, self._ns())

    def arrive(self, *numbers: int, length: int = 8) -> None:
        """Receive frames of other nodes."""
        for number in numbers:
            emulation.arrive(self.bus, self.places, frame_of(number, bytes(length)), 1, self._ns())
        assert not emulation.is_ready(self.bus, self.places, self._ns())

    def heard_at(self, after: float) -> list[int]:
        """The frames delivered until ``after`` s after the start."""
        self.now = 100.0 + after
        out, frame = [], np.zeros(1, frame_dtype)
        while emulation.is_ready(self.bus, self.places, self._ns()):
            emulation.deliver(self.bus, self.places, frame)
            out.append(int(frame["id"][0]))
        return out


def test_a_frame_takes_its_time():
    world = World()
    world.arrive(5)
    assert world.heard_at(0.999 * FRAME) == []
    assert world.heard_at(1.001 * FRAME) == [5]


def test_a_frame_of_can_fd_takes_its_own():
    world = World(fd=True)
    world.arrive(5, length=12)
    time = frame_time(12, True, BITRATE, 8 * BITRATE)
    assert world.heard_at(0.999 * time) == []
    assert world.heard_at(1.001 * time) == [5]


def test_ours_keeps_others_waiting():
    world = World()
    world.send(900)
    world.now += 0.5 * FRAME
    world.arrive(5)
    assert world.heard_at(1.999 * FRAME) == []
    assert world.heard_at(2.001 * FRAME) == [5]


def test_the_lowest_of_those_that_wait_goes_next():
    world = World()
    world.arrive(700)  # occupies the bus
    world.now += 0.1 * FRAME
    world.arrive(300)
    world.now += 0.1 * FRAME
    world.arrive(400, 100)
    world.send(200)
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
    world.arrive(5, 6)
    assert not world.heard_at(0.5 * FRAME)
    emulation.arrive(world.bus, world.places, frame_of(ERROR | 0x40, bytes(8)), 1, 0)
    assert world.heard_at(0.5 * FRAME) == [ERROR | 0x40]
    assert world.heard_at(2.001 * FRAME) == [5, 6]


def test_it_keeps_no_more_than_it_has_places_for():
    world = World()
    for k in range(emulation.PLACES + 1):  # the first is on the bus
        assert emulation.has_room(world.bus)
        world.arrive(k)
    assert not emulation.has_room(world.bus)
    assert world.heard_at((emulation.PLACES + 1.1) * FRAME) == list(range(emulation.PLACES + 1))
    assert emulation.has_room(world.bus)


@pytest.mark.parametrize("portable", [True, False])
def test_a_link_waits_for_what_is_on_the_bus(tmp_path, portable):
    """A segment of the handshake, 13 ms at 10 kbit/s."""
    slow = {"fd": False, "bitrate": 10_000, "every": 50, "emulate": True, "portable": portable}
    endpoint = link_kind("can").fresh(tmp_path)
    one, other = (open_link("can", role, endpoint, slow) for role in ("plant", "controller"))
    try:
        begin = time.monotonic()
        one.send(b"")
        assert other.wait(5.0) and time.monotonic() - begin > 0.01
        while other.receive() is None:
            assert other.wait(5.0)
        assert not other.wait(0.001)
    finally:
        one.close()
        other.close()


@pytest.mark.parametrize("length", [0, 3, 8])
def test_shorter_frames_take_less(length):
    world = World()
    world.arrive(5, length=length)
    assert world.heard_at(1.001 * frame_time(length, False, BITRATE, BITRATE)) == [5]
