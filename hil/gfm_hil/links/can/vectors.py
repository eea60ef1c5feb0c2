"""Between the bench's frames and the bus: a vector becomes CAN frames, and a frame again.

A frame of the bench has a sequence (incremented with every frame sent) and a tick (unchanged in a
repeat); the lag is sequence minus tick. On the bus a vector carries the low six bits of its
sequence and the lowest bit of its lag in the byte ``Counter``; the receiver extends them from the
last sequence. State and lag travel in a status frame ahead of the values, with 32 bits of the
tick: when one of them has changed, at that tick and the next, and every ``heartbeat`` vectors.
Values sent with a change are marked, and the receiver discards them without their status: in
lockstep, where a tick ends only once its frame was received, no values can pass for another tick.
In real time, a receiver that lost both status frames of a change, or more than 58 vectors in a
row, takes new values for older ones or refuses them until the next heartbeat; after the latter
loss the count of lost frames misses multiples of 64.

A CAN frame that fails its check becomes a frame that fails the reader's check and is counted.
"""

import numpy as np

from gfm_hil.links.can import wire
from gfm_hil.links.can.dbc import SENDERS
from gfm_hil.links.can.layout import Plan, pack_vector, unpack_vector
from gfm_hil.realtime.atomics import copy
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import Vector

#: a CAN frame: identifier and payload
CanFrame = tuple[int, bytes]

NOTHING = -1
PARTS = wire.VALUES  # most CAN frames of a vector

_SEQUENCES = 64  # range of the counter's six bits
_LAG, _MARK = 0x40, 0x80  # its other bits
_BEHIND = 4  # how many of these sequences count as older vectors
_LOW = 0xFFFF_FFFF
_STATUS = ("State", "Reason", "Tick")  # signals of a status frame, in this order

#: a vector's frames by the DBC; part k holds the values first[k] to first[k + 1]
_TABLE = [
    ("parts", "i8"),
    ("flags", "i8"),  # of a CAN FD frame
    ("number", "i8", (PARTS,)),
    ("length", "i8", (PARTS,)),
    ("data_id", "i8", (PARTS,)),
    ("first", "i8", (PARTS + 1,)),
    ("index", "i8", (wire.VALUES,)),
    ("start", "i8", (wire.VALUES,)),
    ("scale", "f8", (wire.VALUES,)),
    ("offset", "f8", (wire.VALUES,)),
    ("status_number", "i8"),
    ("status_length", "i8"),
    ("status_data_id", "i8"),
    ("status_at", "i8", (len(_STATUS),)),
    ("status_width", "i8", (len(_STATUS),)),
    ("size", "i8"),  # of the bench's frames
    ("head", "i8"),
]

sender_dtype = np.dtype(
    [
        *_TABLE,
        ("heartbeat", "i8"),
        ("since", "i8"),  # vectors since the last status
        ("last", "i8", (3,)),  # state, reason and lag sent last
        ("tick", "i8"),  # sent last
        ("ticks", "i8"),  # number of ticks that still send a status with the values
        ("saturated", "i8"),  # values that lay outside 16 bits
        ("values", "f8", (wire.VALUES,)),
    ]
)
receiver_dtype = np.dtype(
    [
        *_TABLE,
        ("sequence", "i8"),  # of the newest frame
        ("lag", "i8"),
        ("status_sequence", "i8"),  # sequence of the newest status
        ("last", "i8", (2,)),  # its state and reason
        ("counter", "i8"),  # of the vector being assembled
        ("have", "i8"),  # its received parts, a bit mask
        ("incomplete", "i8"),  # vectors without one of their parts or their status
        ("values", "f8", (wire.VALUES,)),
    ]
)


def set_sender(sender: np.ndarray, plan: Plan, group: Vector, heartbeat: int) -> None:
    """Initialise one record of ``sender_dtype``; it repeats the status every ``heartbeat``
    vectors."""
    _set_table(sender, plan, group)
    sender["heartbeat"], sender["last"], sender["tick"] = heartbeat, NOTHING, NOTHING


def set_receiver(receiver: np.ndarray, plan: Plan, group: Vector) -> None:
    """Initialise one record of ``receiver_dtype``."""
    _set_table(receiver, plan, group)
    receiver["sequence"] = receiver["status_sequence"] = receiver["counter"] = NOTHING


def _set_table(record: np.ndarray, plan: Plan, group: Vector) -> None:
    r, parts, status = record[0], plan.vectors[group], plan.status[SENDERS[group]]
    r["parts"], r["flags"] = len(parts), plan.fd * (wire.FD | wire.BRS)
    r["size"], r["head"] = wire.size_and_head(group, plan.inner)
    done = 0
    for k, part in enumerate(parts):
        r["number"][k], r["length"][k], r["data_id"][k] = part.number, part.length, part.data_id
        end = done + len(part.index)
        for name in ("index", "start", "scale", "offset"):
            r[name][done:end] = getattr(part, name)
        done = r["first"][k + 1] = end
    r["status_number"], r["status_length"] = status.number, status.length
    r["status_data_id"] = status.data_id
    fields = status.dtype.fields
    assert fields is not None
    r["status_at"] = [fields[name][1] for name in _STATUS]
    r["status_width"] = [fields[name][0].itemsize for name in _STATUS]


@compiled
def encode(sender, message, frames):
    """The CAN frames of a frame of the bench, in the order in which to send them.

    Args:
        sender: one record of ``sender_dtype``.
        message: bytes.
        frames: of ``wire.frame_dtype``, written; room for one more than there are parts.

    Returns:
        How many; NOTHING if the message is not a frame of this vector.
    """
    s, size = sender[0], len(message)
    if size != s.size or not wire.begins_with(s.head, message):
        return NOTHING
    state, reason = np.int64(message[wire.STATE]), np.int64(message[wire.REASON])
    sequence, tick = wire.number(message, wire.SEQUENCE, 4), wire.number(message, wire.TICK, 8)
    lag = (sequence - tick) & _LOW
    copy(s.values.ctypes.data, message.ctypes.data + wire.FIRST, size - wire.FIRST - wire.CRC_BYTES)
    good = wire.undamaged(message, size)
    if good:
        if tick != s.tick and s.ticks > 0:
            s.ticks -= 1
        s.tick = tick
        if state != s.last[0] or reason != s.last[1] or lag != s.last[2]:
            s.last[0], s.last[1], s.last[2] = state, reason, lag
            s.ticks = 2
    counter = sequence % _SEQUENCES | (lag & 1) * _LAG | (s.ticks > 0) * _MARK
    count = 0
    if good and (s.ticks > 0 or s.since >= s.heartbeat):
        _head(frames[0], s.status_number, s.status_length, s.flags)
        data = frames[0].data[: s.status_length]
        data[:] = 0
        wire.put_number(data, s.status_at[0], s.status_width[0], state)
        wire.put_number(data, s.status_at[1], s.status_width[1], reason)
        wire.put_number(data, s.status_at[2], s.status_width[2], tick)
        data[1] = counter
        data[0] = wire.crc8(s.status_data_id, data)
        count, s.since = 1, 0
    s.since += 1
    for k in range(s.parts):
        a, b = s.first[k], s.first[k + 1]
        _head(frames[count], s.number[k], s.length[k], s.flags)
        data = frames[count].data[: s.length[k]]
        data[:] = 0  # also the bytes that carry no value
        s.saturated += pack_vector(
            s.values, s.index[a:b], s.start[a:b], s.scale[a:b], s.offset[a:b], s.data_id[k],
            counter, data,
        )  # fmt: skip
        if not good:  # it came here damaged and must arrive damaged
            data[0] ^= 0xFF
        count += 1
    return count


@compiled
def _head(frame, number, length, flags):
    frame.id, frame.length, frame.flags = number, length, flags


@compiled
def belongs(receiver, number):
    """Whether an identifier belongs to this vector or to its sender's status."""
    r = receiver[0]
    for k in range(r.parts):
        if r.number[k] == number:
            return True
    return number == r.status_number


@compiled
def decode(receiver, frame, message):
    """Take a CAN frame of this vector (see ``belongs``).

    Args:
        receiver: one record of ``receiver_dtype``.
        frame: one record of ``wire.frame_dtype``.
        message: bytes, with room for a frame of the bench, written.

    Returns:
        The length of the frame of the bench that it completes, or NOTHING.
    """
    r = receiver[0]
    part, length, data_id = -1, r.status_length, r.status_data_id
    for k in range(r.parts):
        if r.number[k] == frame.id:
            part, length, data_id = k, r.length[k], r.data_id[k]
    data = frame.data[: frame.length]
    if len(data) != length or data[0] != wire.crc8(data_id, data):
        message[: r.size] = 0  # a CRC of 0 is wrong for it
        return r.size
    if part < 0:
        _take_status(r, data)
        return NOTHING
    return _take_values(r, part, data, message)


@compiled
def _take_status(r, data):
    sequence = _extend(r, np.int64(data[1]))
    if sequence < r.sequence:
        return
    tick = r.sequence - r.lag
    low = wire.number(data, r.status_at[2], r.status_width[2])
    tick += (low - tick + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000
    r.lag, r.status_sequence = sequence - tick, sequence
    for k in range(2):
        r.last[k] = wire.number(data, r.status_at[k], r.status_width[k])


@compiled
def _extend(r, counter):
    """The full sequence from its received low bits."""
    return r.sequence + (counter - r.sequence + _BEHIND) % _SEQUENCES - _BEHIND


@compiled
def _take_values(r, part, data, message):
    counter = np.int64(data[1])
    if counter != r.counter:
        r.incomplete += r.have != 0
        r.counter, r.have = counter, 0
    a, b = r.first[part], r.first[part + 1]
    unpack_vector(
        data, r.index[a:b], r.start[a:b], r.scale[a:b], r.offset[a:b], r.values
    )  # fmt: skip
    r.have |= 1 << part
    if r.have != (1 << r.parts) - 1:
        return NOTHING
    r.have = 0
    sequence = _extend(r, counter)
    unknown = counter & _MARK != 0 and sequence != r.status_sequence
    if unknown or (counter & _LAG != 0) != (r.lag & 1 != 0):  # the tick is unknown
        r.incomplete += 1
        return NOTHING
    r.sequence = max(r.sequence, sequence)
    wire.put_number(message, 0, wire.STATE, r.head)
    message[wire.STATE], message[wire.REASON] = r.last[0], r.last[1]
    wire.put_number(message, wire.SPARE, wire.SEQUENCE - wire.SPARE, 0)
    wire.put_number(message, wire.SEQUENCE, 4, sequence & _LOW)
    wire.put_number(message, wire.TICK, 8, sequence - r.lag)  # negative: reads as ≥ 2**63, refused
    copy(
        message.ctypes.data + wire.FIRST, r.values.ctypes.data, r.size - wire.FIRST - wire.CRC_BYTES
    )
    wire.seal(message, r.size)
    return r.size


class VectorSender:
    """Makes CAN frames of one side's vectors, for Python.

    Args:
        plan: of the DBC.
        group: ``"y"`` or ``"u"``.
        heartbeat: vectors after which the status is repeated.
    """

    def __init__(self, plan: Plan, group: Vector, heartbeat: int) -> None:
        self.record = np.zeros(1, sender_dtype)
        set_sender(self.record, plan, group, heartbeat)
        self._frames = np.zeros(PARTS + 1, wire.frame_dtype)

    def frames(self, message: bytes) -> list[CanFrame]:
        """The CAN frames of a frame of the bench, in the order in which to send them."""
        count = encode(self.record, np.frombuffer(message, np.uint8), self._frames)
        frames = self._frames[: max(0, count)]
        return [(int(f["id"]), f["data"][: f["length"]].tobytes()) for f in frames]
