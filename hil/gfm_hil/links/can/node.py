"""One side's node on a bus, compiled: it turns messages into frames, and frames into messages.

All state of a node lies in one int64 array, which is the ``handle`` of its port, so that Python
and compiled loops use the same node through the same code. The node reads and writes a socket, see
``sockets``.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import OTHER, Role
from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.emulation import (
    PLACES,
    arrive,
    bus_dtype,
    busy,
    deliver,
    has_room,
    is_ready,
    place_dtype,
    set_bus,
)
from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.sockets import FULL, POLL_AT, read_frame, socket_dtype, write_frame
from gfm_hil.links.can.vectors import (
    PARTS,
    decode,
    encode,
    part_of,
    receiver_dtype,
    sender_dtype,
    set_receiver,
    set_sender,
)
from gfm_hil.links.can.wire import BUS_OFF, ERROR, frame_dtype
from gfm_hil.links.port import Port, free_port_function
from gfm_hil.links.system import poll
from gfm_hil.realtime.clock import now_ns
from gfm_runtime.compiled import compiled, expanded, inlined

#: no message; the bus is lost, see ``lost``; a frame of the handshake came, in ``into``
NOTHING, LOST, TRANSPORT = -1, -2, -3

_AT_ONCE = 64  # frames processed per call, so that a flood of foreign frames cannot block it

#: ``lost`` says why: an errno, or this
WENT_BUS_OFF = -1

state_dtype = np.dtype(
    [
        ("open", "i8"),
        ("lost", "i8"),  # 0: the bus works
        ("transport", "i8"),  # identifier of the peer's frames of the handshake
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
        self.state, self.sockets, self.bus = views["state"], views["sockets"], views["bus"]
        self.sender, self.receiver = views["sender"], views["receiver"]
        self.out, self.into = views["out"], views["into"]
        self.state["open"] = 1
        self.state["transport"] = plan.transport[OTHER[role]]
        plant = role == "plant"
        set_sender(self.sender, plan, "y" if plant else "u", options.heartbeat)
        set_receiver(self.receiver, plan, "u" if plant else "y")
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
    return expanded(part)


_state, _sockets, _sender, _receiver, _bus, _places, _out, _into = map(_part, _SIZES)


@compiled
def put(handle, frame):
    """Send the frame in an array; False if it was dropped or the bus is lost."""
    state, bus = _state(handle), _bus(handle)
    if bus[0].waiting >= PLACES:
        state[0].dropped += 1
        return False
    problem = write_frame(_sockets(handle), frame)
    if problem == 0:
        if bus[0].emulate:
            arrive(bus, _places(handle), frame, 0, now_ns())
        return True
    if problem in FULL:
        state[0].dropped += 1
    else:
        state[0].lost = problem
    return False


@compiled
def send(handle, message):
    """Send a message of the loops: 1; 0 if any part of it was dropped; NOTHING if it is not a frame
    of the loops."""
    if _state(handle)[0].open == 0:
        return 0
    out = _out(handle)
    count = encode(_sender(handle), message, out)
    if count == NOTHING:
        return NOTHING
    sent = 1
    for k in range(count):
        if not put(handle, out[k : k + 1]):
            sent = 0
    return sent


@inlined
def _read(handle, frame):
    """Whether the socket has a frame, which is then read; if it is lost, ``lost`` says why."""
    came = read_frame(_sockets(handle), frame)
    if came < 0:
        _state(handle)[0].lost = -came
    return came > 0


@compiled
def fetch(handle):
    """Read the frames that the socket has; returns whether one is ready to be processed."""
    bus, places, into = _bus(handle), _places(handle), _into(handle)
    # an emulated bus needs every frame's time of arrival: read them all now
    while has_room(bus) and (bus[0].emulate or bus[0].ready == 0) and _read(handle, into):
        arrive(bus, places, into, 1, now_ns() if bus[0].emulate else 0)
    return is_ready(bus, places, now_ns() if bus[0].emulate else 0)


@compiled
def _take_frame(handle, frame):
    """The next frame to process, if there is one: of those that were fetched, or of the socket."""
    bus = _bus(handle)
    if bus[0].emulate or bus[0].ready > 0:
        there = fetch(handle)
        if there:
            deliver(bus, _places(handle), frame)
        return there
    return _read(handle, frame)


@compiled
def receive(handle, message):
    """The next message.

    Args:
        handle: of the node.
        message: bytes, with room for a frame of the bench, written.

    Returns:
        Its length, NOTHING, LOST or TRANSPORT.
    """
    state = _state(handle)
    if state[0].open == 0:
        return NOTHING
    frame = _into(handle)
    for _ in range(_AT_ONCE):
        there = state[0].lost == 0 and _take_frame(handle, frame)
        if state[0].lost != 0:
            return LOST
        if not there:
            return NOTHING
        size = process(handle, frame[0], message)
        if size != NOTHING:
            return size
    return NOTHING


@compiled
def process(handle, frame, message):
    """Process a frame; returns the length of the message that it completes, or as ``receive``."""
    state, receiver = _state(handle)[0], _receiver(handle)
    if frame.id & ERROR:
        state.error_frames += 1
        if frame.id & BUS_OFF:
            state.lost = WENT_BUS_OFF
            return LOST
        return NOTHING
    part = part_of(receiver, frame.id)
    if part != NOTHING:
        return decode(receiver, part, frame, message)
    if frame.id == state.transport:
        return TRANSPORT
    state.foreign += 1  # so is a remote or an extended frame: its flag is in ``id``
    return NOTHING


_SPINS = 200  # polls, about 0.1 ms: the call that sends a frame also delivers it
_PATIENCE_MS = 1


def can_port(node: Node) -> Port:
    """The port of a node with an open socket."""
    return Port(node.handle, _send, _receive, _SPINS, _await)


@free_port_function
def _send(handle, message):
    return max(0, send(handle, message))


@free_port_function
def _receive(handle, message):
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)


@free_port_function
def _await(handle, message):
    if _state(handle)[0].open != 0 and not busy(_bus(handle)):  # a frame on the bus comes sooner
        poll(_sockets(handle).ctypes.data + POLL_AT, 1, _PATIENCE_MS)
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)
