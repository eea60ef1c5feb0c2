"""Exchange frames only every n-th tick, for a slow bus, and hold the values in between.

At tick k, a multiple of n, the plant sends y[k] and the controller answers u[k], which has n ticks
to arrive and takes effect at k + n (before tick n the plant uses u[0]): a delay of n ticks, in
lockstep as in real time. The controller steps at every tick: it makes up the ticks in between with
the last y, just before it takes the next. This module makes the frames of those ticks and numbers
them so that the reader counts n lost frames for one that the bus lost. A side that leaves sends
its last frames at once.
"""

from __future__ import annotations

import numpy as np

from gfm_hil.core.roles import Role
from gfm_hil.links.can import wire
from gfm_runtime.compiled import cached
from gfm_runtime.signals import Vector
from gfm_runtime.states import RUNNING, STOPPED

NOTHING = -1

_KEPT = 4  # commands stored: the one in force, its successor, and early ones
_ROOM = (wire.MOST + 7) // 8 * 8
_LOW = 0xFFFF_FFFF

subrate_dtype = np.dtype(
    [
        ("every", "i8"),  # n
        ("plant", "i8"),  # which side this is
        ("size", "i8", (2,)),  # of our frames and of theirs
        ("head", "i8", (2,)),
        ("ordinary", "i8", (2,)),  # the state byte of each side while it runs
        # the controller: the last measurement, and the next one, which waits until the frames of
        # the ticks before it are made; ``left`` frames remain, the next measurement included
        ("has", "i8"),
        ("left", "i8"),
        ("last", "u1", (_ROOM,)),
        ("next", "u1", (_ROOM,)),
        # the plant
        ("due", "i8"),  # tick for which it needs a command
        ("asked", "i8"),  # newest tick of its measurements
        ("again", "i8"),  # commands received again
        ("given", "i8"),  # sequence of the last frame given to the reader
        ("ticks", "i8", (_KEPT + 1,)),  # tick of each stored command; NOTHING: free
        ("sequences", "i8", (_KEPT + 1,)),  # their sequences, not counting repeats
        ("commands", "u1", ((_KEPT + 1) * _ROOM,)),
    ]
)


def set_subrate(subrate: np.ndarray, role: Role, every: int, inner: bool = False) -> None:
    """Initialise one record of ``subrate_dtype`` for a side that exchanges every n-th tick;
    ``inner``: in a run with an inner stage."""
    s, plant = subrate[0], role == "plant"
    groups: tuple[Vector, Vector] = ("y", "u") if plant else ("u", "y")
    s["every"], s["plant"] = every, plant
    for k, group in enumerate(groups):
        s["size"][k], s["head"][k] = wire.size_and_head(group, inner)
    s["ordinary"] = (0, RUNNING) if plant else (RUNNING, 0)
    s["due"] = s["asked"] = s["given"] = s["ticks"] = NOTHING


@cached
def _good(s, whose, message, size):
    if size != s.size[whose] or not wire.begins_with(s.head[whose], message):
        return False
    return wire.undamaged(message, size)


@cached
def goes(subrate, message):
    """Whether to send a message of ours; called for every message."""
    s = subrate[0]
    if not _good(s, 0, message, len(message)):
        return True
    tick = s.asked = wire.number(message, wire.TICK, 8)
    s.due = NOTHING if message[wire.STATE] == STOPPED else tick  # a leaving plant needs no command
    return tick % s.every == 0 or message[wire.STATE] != s.ordinary[0]


@cached
def _under(message, size, tick, sequence):
    """Rewrite a frame's tick and sequence."""
    wire.put_number(message, wire.TICK, 8, tick)
    wire.put_number(message, wire.SEQUENCE, 4, sequence & _LOW)
    wire.seal(message, size)
    return size


@cached
def made(subrate, message):
    """Write the next frame made for the reader: its length, or NOTHING."""
    s = subrate[0]
    if s.left == 0:
        return NOTHING
    s.left -= 1
    size = s.size[1]
    if s.left == 0:
        message[:size] = s.next[:size]
        s.last[:size] = s.next[:size]
        return size
    message[:size] = s.last[:size]
    tick, sequence = wire.number(s.next, wire.TICK, 8), wire.number(s.next, wire.SEQUENCE, 4)
    return _under(message, size, tick - s.left, sequence - s.left)


@cached
def admit(subrate, message, size):
    """Take a message from the bus and replace it in ``message`` by the one for the reader;
    returns its length, or NOTHING."""
    s = subrate[0]
    if not _good(s, 1, message, size):
        return size  # damaged or another message: the reader checks and counts it
    return _command(s, message, size) if s.plant else _measurement(subrate, message, size)


@cached
def _measurement(subrate, message, size):
    s = subrate[0]
    missing = 0
    if s.has:
        missing = wire.number(message, wire.TICK, 8) - wire.number(s.last, wire.TICK, 8) - 1
    s.has = 1
    if missing <= 0:
        s.last[:size] = message[:size]
        return size
    s.next[:size] = message[:size]
    s.left = min(s.every - 1, missing) + 1
    return made(subrate, message)


@cached
def _command(s, message, size):
    tick, sequence = wire.number(message, wire.TICK, 8), wire.number(message, wire.SEQUENCE, 4)
    free, oldest = -1, 0
    for k in range(_KEPT + 1):
        if s.ticks[k] == tick:  # a repeat: the reader too gets a repeated frame
            s.again += 1
            return _under(message, size, tick, s.given)
        if s.ticks[k] == NOTHING:
            free = k
    if message[wire.STATE] != s.ordinary[1] or not s.asked - _KEPT * s.every <= tick <= s.asked:
        return _under(message, size, tick, s.given + 1)
    s.ticks[free], s.sequences[free] = tick, sequence - s.again
    s.commands[free * _ROOM : free * _ROOM + size] = message[:size]
    for k in range(_KEPT + 1):
        if s.ticks[k] == NOTHING:
            return NOTHING
        if s.ticks[k] < s.ticks[oldest]:
            oldest = k
    s.ticks[oldest] = NOTHING
    return NOTHING


@cached
def in_force(subrate, message):
    """The plant: write the command for the tick that is due; returns its length, or NOTHING if it
    has not arrived."""
    s = subrate[0]
    if s.due < 0:
        return NOTHING
    tick = max(0, (s.due // s.every - 1) * s.every)
    for k in range(_KEPT + 1):
        if s.ticks[k] == tick:
            size = s.size[1]
            message[:size] = s.commands[k * _ROOM : k * _ROOM + size]
            s.given = s.sequences[k] + s.due - tick
            due, s.due = s.due, NOTHING
            return _under(message, size, due, s.given)
    return NOTHING
