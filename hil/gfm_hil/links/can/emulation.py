"""The queue of received frames; on a virtual bus it delays them as a real bus would.

Every node computes the same schedule: it knows when it sent, and it sees the others' frames within
microseconds. While a frame is on the bus, the others wait. The lowest waiting identifier goes
next; each frame takes its longest time (``bus_time``) and is delivered no earlier than at its
end. The clock is the wall clock, so the delay matters only in real time: a run in lockstep takes
longer and gives the same results. Without emulation a frame is delivered as it arrives.
"""

import numpy as np

from gfm_hil.links.can.bus_time import frame_time
from gfm_hil.links.can.dbc import PAYLOADS
from gfm_hil.links.can.wire import ERROR, MTU_FD, frame_dtype
from gfm_hil.realtime.atomics import copy
from gfm_runtime.compiled import compiled

PLACES = 128  # for frames that wait for the bus, and as many again for frames that were sent
_LONGEST = PAYLOADS[-1]

bus_dtype = np.dtype(
    [
        ("emulate", "i8"),
        ("free", "i8"),  # when the frame on the bus ends, ns
        ("waiting", "i8"),  # frames
        ("first", "i8"),  # index of the next frame to deliver
        ("ready", "i8"),  # frames ready for delivery
        ("time", "i8", (_LONGEST + 1,)),  # time on the bus by number of data bytes, ns
    ]
)

#: a frame in one of 2 PLACES: since when it has waited or when it leaves the bus (ns), and whether
#: another node sent it, so that it must be delivered
place_dtype = np.dtype([("at", "i8"), ("deliver", "i8"), *frame_dtype.descr])
_FRAME_AT = 16


def set_bus(bus: np.ndarray, fd: bool, bitrate: int, data_bitrate: int) -> None:
    """Make one record of ``bus_dtype`` emulate a bus with these bit rates, bit/s."""
    bus["emulate"] = 1
    for length in range(_LONGEST + 1 if fd else 9):
        sent = next(n for n in PAYLOADS if n >= length)
        bus["time"][0, length] = round(frame_time(sent, fd, bitrate, data_bitrate) * 1e9)


@compiled
def has_room(bus):
    """Whether another frame may ``arrive``."""
    return bus[0].waiting < PLACES and bus[0].ready < PLACES


@compiled
def busy(bus):
    """Whether a frame is on the bus or waits for it."""
    return bus[0].waiting > 0 or bus[0].ready > 0


@compiled
def arrive(bus, places, frame, deliver, now):
    """Queue a frame; one of our own (``deliver`` = 0) only occupies the bus.

    Args:
        bus: one record of ``bus_dtype``.
        places: shape (2 PLACES,) of ``place_dtype``.
        frame: one record of ``wire.frame_dtype``, in an array.
        now: ns.
    """
    b = bus[0]
    if not b.emulate:
        _fill(places, PLACES + (b.first + b.ready) % PLACES, frame, 1, 0)
        b.ready += 1
    elif frame[0].id & ERROR:  # an error frame concerns this node only: no arbitration
        b.first = (b.first - 1) % PLACES
        _fill(places, PLACES + b.first, frame, 1, 0)
        b.ready += 1
    else:
        _fill(places, b.waiting, frame, deliver, now)
        b.waiting += 1


@compiled
def _fill(places, k, frame, deliver, at):
    places[k].at, places[k].deliver = at, deliver
    copy(places[k : k + 1].ctypes.data + _FRAME_AT, frame.ctypes.data, MTU_FD)


@compiled
def _arbitrate(b, places, now):
    """Move every frame that has won arbitration by now from waiting to delivery."""
    while b.waiting > 0 and b.ready < PLACES:
        start = places[0].at
        for k in range(1, b.waiting):
            start = min(start, places[k].at)
        start = max(start, b.free)
        if start > now:
            return
        best = -1
        for k in range(b.waiting):
            if places[k].at <= start and (best < 0 or places[k].id < places[best].id):
                best = k
        b.free = start + b.time[places[best].length]
        if places[best].deliver:
            to = PLACES + (b.first + b.ready) % PLACES
            places[to] = places[best]
            places[to].at = b.free
            b.ready += 1
        b.waiting -= 1
        for k in range(best, b.waiting):  # keep the order of arrival
            places[k] = places[k + 1]


@compiled
def is_ready(bus, places, now):
    """Whether a frame is ready for delivery."""
    b = bus[0]
    if b.waiting > 0:
        _arbitrate(b, places, now)
    return b.ready > 0 and places[PLACES + b.first].at <= now


@compiled
def deliver(bus, places, frame):
    """Copy the frame that ``is_ready`` found into ``frame``, an array of ``wire.frame_dtype``."""
    b = bus[0]
    copy(
        frame.ctypes.data, places[PLACES + b.first : PLACES + b.first + 1].ctypes.data + _FRAME_AT,
        MTU_FD,
    )  # fmt: skip
    b.first = (b.first + 1) % PLACES
    b.ready -= 1
