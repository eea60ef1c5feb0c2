"""One side's node on a bus, compiled: it turns messages into frames, and frames into messages.

All state of a node lies in one int64 array, which is the ``handle`` of its port, so that Python
and compiled loops use the same node through the same code. The node reads and writes a socket
(see ``sockets``), or Python moves the frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import Role
from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.emulation import (
    PLACES,
    arrive,
    bus_dtype,
    busy,
    deliver,
    has_room,
    is_through,
    place_dtype,
    set_bus,
)
from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.segments import OTHER_DBC, join, joiner_dtype, set_joiner
from gfm_hil.links.can.sockets import (
    FULL,
    PORTABLE,
    read_frame,
    sleep_for_frame,
    socket_dtype,
    write_frame,
)
from gfm_hil.links.can.subrate import admit, goes, in_force, made, set_subrate, subrate_dtype
from gfm_hil.links.can.vectors import (
    PARTS,
    decode,
    encode,
    knows,
    receiver_dtype,
    sender_dtype,
    set_receiver,
    set_sender,
)
from gfm_hil.links.can.wire import BUS_OFF, ERROR, EXTENDED, REMOTE, frame_dtype
from gfm_hil.links.port import Port, port_function
from gfm_hil.realtime.clock import now_ns
from gfm_runtime.compiled import cached

NOTHING, LOST = -1, -2  # no message; the bus is lost, see ``lost``

_AT_ONCE = 64  # frames processed per call, so that a flood of foreign frames cannot block it

#: ``lost`` says why: an errno, or one of these
WENT_BUS_OFF, ANOTHER_DBC = -1, -2

state_dtype = np.dtype(
    [
        ("open", "i8"),
        ("lost", "i8"),  # 0: the bus works
        ("foreign", "i8"),  # frames whose identifiers this link does not use
        ("error_frames", "i8"),
        ("dropped", "i8"),  # our frames dropped for lack of room
    ]
)

FRAMES = PARTS + 1  # most CAN frames that one message of the loops becomes
_WORD = 8
_SIZES = {
    "state": (state_dtype, 1),
    "sockets": (socket_dtype, 1),
    "sender": (sender_dtype, 1),
    "receiver": (receiver_dtype, 1),
    "joiner": (joiner_dtype, 1),
    "subrate": (subrate_dtype, 1),
    "bus": (bus_dtype, 1),
    "places": (place_dtype, 2 * PLACES),
    "out": (frame_dtype, FRAMES),
    "into": (frame_dtype, 1),
}
_ENDS = np.cumsum([dtype.itemsize * count for dtype, count in _SIZES.values()]) // _WORD


class Node:
    """The array and, for Python, views of its parts; see the dtypes."""

    def __init__(self, plan: Plan, role: Role, options: CanOptions) -> None:
        self.handle: NDArray[np.int64] = np.zeros(_ENDS[-1], np.int64)
        parts = np.split(self.handle, _ENDS[:-1])
        views = {
            name: part.view(dtype)
            for (name, (dtype, _)), part in zip(_SIZES.items(), parts, strict=True)
        }
        self.state, self.sockets, self.joiner = views["state"], views["sockets"], views["joiner"]
        self.sender, self.receiver = views["sender"], views["receiver"]
        self.bus, self.places, self.out = views["bus"], views["places"], views["out"]
        self.state["open"] = 1
        plant = role == "plant"
        set_sender(self.sender, plan, "y" if plant else "u", options.heartbeat)
        set_receiver(self.receiver, plan, "u" if plant else "y")
        set_joiner(self.joiner, plan, role)
        set_subrate(views["subrate"], role, options.every, plan.inner)
        if options.emulate:
            set_bus(self.bus, options.fd, options.bitrate, options.data_bitrate)


def _part(name: str) -> Any:
    """A compiled function that gives a part of the node, as records, from the handle."""
    k, (dtype, _) = list(_SIZES).index(name), _SIZES[name]
    first, last = int(_ENDS[k - 1]) if k else 0, int(_ENDS[k])

    def part(handle):
        return handle[first:last].view(dtype)

    # numba tells functions apart by name and by a number that counts in each process. Two parts of
    # one name, compiled by two processes and loaded from its cache by a third, could be confused.
    part.__qualname__ = part.__name__ = f"part_{name}"
    return cached(part)


_state, _sockets, _sender, _receiver, _joiner, _subrate, _bus, _places, _out, _into = map(
    _part, _SIZES
)


@cached
def compose(handle, message):
    """Write the CAN frames of a message to ``out``; returns how many, or NOTHING if the message is
    not a frame of the loops and must be sent in segments."""
    subrate = _subrate(handle)
    if subrate[0].every > 1 and not goes(subrate, message):
        return 0
    return encode(_sender(handle), message, _out(handle))


@cached
def room_to_send(handle):
    """Whether there is room to send another frame; if not, count it as dropped."""
    if _bus(handle)[0].waiting < PLACES:
        return True
    _state(handle)[0].dropped += 1
    return False


@cached
def account(handle, frame):
    """Let a frame that we have sent occupy the emulated bus."""
    bus = _bus(handle)
    if bus[0].emulate:
        arrive(bus, _places(handle), frame, 0, now_ns())


@cached
def bring(handle, frame):
    """Queue a frame that another node sent."""
    bus = _bus(handle)
    arrive(bus, _places(handle), frame, 1, now_ns())


@cached
def put(handle, frame):
    """Send the frame in an array; False if it was dropped or the bus is lost."""
    if not room_to_send(handle):
        return False
    problem = write_frame(_sockets(handle), frame)
    if problem == 0:
        account(handle, frame)
        return True
    state = _state(handle)
    if problem in FULL:
        state[0].dropped += 1
    else:
        state[0].lost = problem
    return False


@cached
def send(handle, message):
    """Send a message of the loops: 1, or 0 if any part of it was dropped."""
    if _state(handle)[0].open == 0:
        return 0
    count = compose(handle, message)
    out = _out(handle)
    sent = count >= 0
    for k in range(count):
        if not put(handle, out[k : k + 1]):
            sent = False
    return 1 if sent else 0


@cached
def fetch(handle):
    """Read the frames that the socket has; returns whether one is ready to be processed."""
    sockets, bus = _sockets(handle), _bus(handle)
    places, into = _places(handle), _into(handle)
    if sockets[0].kind != PORTABLE:
        # an emulated bus needs every frame's time of arrival: read them all now
        while has_room(bus) and (bus[0].emulate or bus[0].through == 0):
            came = read_frame(sockets, into)
            if came < 0:
                _state(handle)[0].lost = -came
            if came <= 0:
                break
            arrive(bus, places, into, 1, now_ns() if bus[0].emulate else 0)
    return is_through(bus, places, now_ns() if bus[0].emulate else 0)


@cached
def receive(handle, message):
    """The next message.

    Args:
        handle: of the node.
        message: bytes, with room for a frame of the bench, written; a longer message is cut off.

    Returns:
        Its length, NOTHING, or LOST.
    """
    subrate = _subrate(handle)
    if subrate[0].every == 1:
        return _from_bus(handle, message)
    size = made(subrate, message)
    while size == NOTHING:
        size = _from_bus(handle, message)
        if size == NOTHING:
            return in_force(subrate, message)
        if size == LOST:
            return LOST
        size = admit(subrate, message, size)
    return size


@cached
def _from_bus(handle, message):
    """The next message that came over the bus."""
    state = _state(handle)
    bus, places = _bus(handle), _places(handle)
    frame = _into(handle)
    if state[0].open == 0:
        return NOTHING
    for _ in range(_AT_ONCE):
        there = state[0].lost == 0 and fetch(handle)
        if state[0].lost != 0:
            return LOST
        if not there:
            return NOTHING
        deliver(bus, places, frame)
        size = _take(handle, state[0], frame[0], message)
        if size != NOTHING:
            return size
    return NOTHING


@cached
def _take(handle, state, frame, message):
    """Process a frame; returns the length of the message that it completes, NOTHING, or LOST."""
    receiver, joiner = _receiver(handle), _joiner(handle)
    if frame.id & ERROR:
        state.error_frames += 1
        if frame.id & BUS_OFF:
            state.lost = WENT_BUS_OFF
            return LOST
    elif frame.id & (EXTENDED | REMOTE):
        state.foreign += 1
    elif knows(receiver, frame.id):
        return decode(receiver, frame, message)
    elif frame.id == joiner[0].number:
        size = join(joiner, frame, message)
        if size == OTHER_DBC:
            state.lost = ANOTHER_DBC
            return LOST
        return size
    else:
        state.foreign += 1
    return NOTHING


@cached
def sleep(handle, ms):
    """Sleep until the socket has a frame, at most ``ms``; not while a frame is on the bus."""
    if _state(handle)[0].open != 0 and not busy(_bus(handle)):
        sleep_for_frame(_sockets(handle), ms)


_SPINS = 200  # polls, about 0.1 ms: the call that sends a frame also delivers it
_PATIENCE = 1  # ms


def can_port(node: Node) -> Port:
    """The port of a node with an open socket."""
    return Port(node.handle, _send, _receive, _SPINS, _await)


@port_function
def _send(handle, message):
    return send(handle, message)


@port_function
def _receive(handle, message):
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)


@port_function
def _await(handle, message):
    sleep(handle, _PATIENCE)
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)
