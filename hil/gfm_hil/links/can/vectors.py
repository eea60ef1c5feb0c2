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
from gfm_hil.links.can.dbc import INT16, INVALID, SENDERS
from gfm_hil.links.can.layout import VALUE, Plan
from gfm_hil.links.frame import DATA_IDS, buffer, header_dtype, is_sealed, seal
from gfm_hil.realtime.atomics import copy, load32, store32
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import VectorName, carried

#: a CAN frame: identifier and payload
CanFrame = tuple[int, bytes]

NOTHING = -1
PARTS = wire.VALUES  # most CAN frames of a vector

_SEQUENCES = 64  # range of the counter's six bits
_LAG, _MARK = 0x40, 0x80  # its other bits
_BEHIND = 4  # how many of these sequences count as older vectors
_LOW = 0xFFFF_FFFF
_FIRST = header_dtype.itemsize  # where the values begin in a frame of the bench
_WORD = 8
_STATUS = ("State", "Reason", "Tick")  # signals of a status frame, in this order

#: a vector's frames by the DBC, and after them its sender's status as part ``parts``; part k holds
#: the values first[k] to first[k + 1]
_TABLE = [
    ("parts", "i8"),
    ("flags", "i8"),  # of a CAN FD frame
    ("number", "i8", (PARTS + 1,)),
    ("length", "i8", (PARTS + 1,)),
    ("data_id", "i8", (PARTS + 1,)),
    ("first", "i8", (PARTS + 2,)),
    *((name, kind, (wire.VALUES,)) for name, kind in VALUE),
    ("status_at", "i8", (len(_STATUS),)),
    ("status_width", "i8", (len(_STATUS),)),
    # length and first four bytes of the bench's frames of this vector
    ("size", "i8"),
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


def set_sender(sender: np.ndarray, plan: Plan, group: VectorName, heartbeat: int) -> None:
    """Initialise one record of ``sender_dtype``; it repeats the status every ``heartbeat``
    vectors."""
    _set_table(sender, plan, group)
    sender["heartbeat"], sender["last"], sender["tick"] = heartbeat, NOTHING, NOTHING


def set_receiver(receiver: np.ndarray, plan: Plan, group: VectorName) -> None:
    """Initialise one record of ``receiver_dtype``."""
    _set_table(receiver, plan, group)
    receiver["sequence"] = receiver["status_sequence"] = receiver["counter"] = NOTHING


def _set_table(record: np.ndarray, plan: Plan, group: VectorName) -> None:
    r, parts, status = record[0], plan.vectors[group], plan.status[SENDERS[group]]
    r["parts"], r["flags"] = len(parts), plan.fd * (wire.FD | wire.BRS)
    _, message = buffer(len(carried(group, plan.signal_set)), DATA_IDS[group])
    r["size"], r["head"] = len(message), message[:4].view(np.uint32)[0]
    done = 0
    for k, part in enumerate([*parts, status]):
        r["number"][k], r["length"][k], r["data_id"][k] = part.number, part.length, part.data_id
        end = done + len(part.values)
        for name, _ in VALUE:
            r[name][done:end] = part.values[name]
        done = r["first"][k + 1] = end
    r["status_at"], r["status_width"] = zip(*(status.signals[n] for n in _STATUS), strict=True)


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
    if size != s.size or load32(message.ctypes.data) != s.head:
        return NOTHING
    head = message[:_FIRST].view(header_dtype)[0]
    state, reason = np.int64(head.state), np.int64(head.reason)
    sequence, tick = np.int64(head.sequence), np.int64(head.tick)
    lag = (sequence - tick) & _LOW
    copy(s.values.ctypes.data, message.ctypes.data + _FIRST, _WORD * s.first[s.parts])
    good = is_sealed(message)
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
        _head(frames[0], s, s.parts)
        data = frames[0].data[: s.length[s.parts]]
        data[:] = 0
        wire.put_number(data, s.status_at[0], s.status_width[0], state)
        wire.put_number(data, s.status_at[1], s.status_width[1], reason)
        wire.put_number(data, s.status_at[2], s.status_width[2], tick)
        data[1] = counter
        data[0] = wire.crc8(s.data_id[s.parts], data)
        count, s.since = 1, 0
    s.since += 1
    for k in range(s.parts):
        _head(frames[count], s, k)
        data = frames[count].data[: s.length[k]]
        _pack(s, k, counter, data)
        if not good:  # it came here damaged and must arrive damaged
            data[0] ^= 0xFF
        count += 1
    return count


@compiled
def _pack(s, part, counter, data):
    """Write the values of a part, rounded to counts, into its frame, with the protection."""
    data[:] = 0  # also the bytes that carry no value
    for k in range(s.first[part], s.first[part + 1]):
        nearest = np.rint((s.values[s.index[k]] - s.offset[k]) / s.scale[k])
        if np.isnan(nearest):
            count = INVALID
        elif abs(nearest) > INT16:
            count = INT16 if nearest > 0 else -INT16
            s.saturated += 1
        else:
            count = int(nearest)
        wire.put_number(data, s.start[k], 2, count)
    data[1] = counter
    data[0] = wire.crc8(s.data_id[part], data)


@compiled
def _head(frame, s, part):
    frame.id, frame.length, frame.flags = s.number[part], s.length[part], s.flags


@compiled
def part_of(receiver, number):
    """Which part of this vector, or its sender's status, has an identifier; NOTHING: none."""
    r = receiver[0]
    for k in range(r.parts + 1):
        if r.number[k] == number:
            return k
    return NOTHING


@compiled
def decode(receiver, part, frame, message):
    """Take a CAN frame of this vector.

    Args:
        receiver: one record of ``receiver_dtype``.
        part: of the frame, see ``part_of``.
        frame: one record of ``wire.frame_dtype``.
        message: bytes, with room for a frame of the bench, written.

    Returns:
        The length of the frame of the bench that it completes, or NOTHING.
    """
    r = receiver[0]
    data = frame.data[: frame.length]
    if len(data) != r.length[part] or data[0] != wire.crc8(r.data_id[part], data):
        message[: r.size] = 0  # a CRC of 0 is wrong for it
        return r.size
    if part == r.parts:
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
    for k in range(r.first[part], r.first[part + 1]):
        count = wire.number(data, r.start[k], 2)
        if count >= 0x8000:
            count -= 0x10000
        r.values[r.index[k]] = np.nan if count == INVALID else count * r.scale[k] + r.offset[k]
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
    head = message[:_FIRST].view(header_dtype)[0]
    store32(message.ctypes.data, np.uint32(r.head))
    head.state, head.reason, head.spare = r.last[0], r.last[1], 0
    head.sequence = sequence & _LOW
    head.tick = sequence - r.lag  # negative: reads as ≥ 2**63, refused
    copy(message.ctypes.data + _FIRST, r.values.ctypes.data, _WORD * r.first[r.parts])
    seal(message[: r.size])
    return r.size


class VectorSender:
    """Makes CAN frames of one side's vectors, for Python.

    Args:
        plan: of the DBC.
        group: ``"y"`` or ``"u"``.
        heartbeat: vectors after which the status is repeated.
    """

    def __init__(self, plan: Plan, group: VectorName, heartbeat: int) -> None:
        self.record = np.zeros(1, sender_dtype)
        set_sender(self.record, plan, group, heartbeat)
        self._frames = np.zeros(PARTS + 1, wire.frame_dtype)

    def frames(self, message: bytes) -> list[CanFrame]:
        """The CAN frames of a frame of the bench, in the order in which to send them."""
        count = encode(self.record, np.frombuffer(message, np.uint8), self._frames)
        frames = self._frames[: max(0, count)]
        return [(int(f["id"]), f["data"][: f["length"]].tobytes()) for f in frames]
