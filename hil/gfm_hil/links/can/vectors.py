"""Between the bench's frames and the bus: a vector becomes CAN frames, and a frame again.

A frame of the bench has a sequence (one more for every frame sent) and a tick (the same in one
that was sent again); how far the tick is behind is its lag. On the bus a vector carries the low six
bits of its sequence and the lowest of its lag in the byte ``Counter``; the receiver counts on from
what it had. State and lag travel in a frame of their own ahead of the values, with 32 bits of the
tick: when one of them has changed, at that tick and the next, and every ``heartbeat`` vectors.
Values sent with a change are marked, and worth nothing without it: in lockstep, where a tick goes
on only once it was heard, none can pass for another tick. In real time, whoever lost both changes,
or more than 58 vectors in a row, takes new values for older ones or refuses them until the next
heartbeat; of the latter the count of the lost misses multiples of 64.

What fails its check here is made a frame that fails its own, so that its reader counts it.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np

from gfm_hil.codec import buffer
from gfm_hil.frames import DATA_IDS
from gfm_hil.links.can.dbc import COUNTER, CRC, SENDERS
from gfm_hil.links.can.e2e import crc8
from gfm_hil.links.can.layout import Layout, Plan, pack_vector, unpack_vector
from gfm_runtime.signals import Group, names

#: a CAN frame: identifier and payload
CanFrame = tuple[int, bytes]

_SEQUENCES = 64  # that a counter tells apart
_LAG, _MARK = 0x40, 0x80  # its other bits
_BEHIND = 4  # how many of the sequences mean an older vector
_CRC_BYTES = 4  # at the end of a frame of the bench


def _header(group: Group) -> tuple[struct.Struct, bytes, int]:
    """Layout of a frame's header, an empty frame, and where its values begin.

    By ``struct`` and ``zlib``: a field of a NumPy record costs a microsecond.
    """
    frame, message = buffer(len(names(group)), DATA_IDS[group])
    dtype = frame.dtype
    fields = [dtype[name] for name in dtype.names or () if name not in ("values", "crc")]
    kinds = {1: "B", 2: "H", 4: "I", 8: "Q"}
    layout = struct.Struct("<" + "".join(kinds[field.itemsize] for field in fields))
    return layout, message.tobytes(), layout.size


class VectorSender:
    """Makes CAN frames of one side's vectors.

    Args:
        plan: of the DBC.
        group: ``"y"`` or ``"u"``.
        heartbeat: vectors after which the state is said again.
    """

    def __init__(self, plan: Plan, group: Group, heartbeat: int) -> None:
        self._header, self._empty, self._at = _header(group)
        self._parts = [(part, np.zeros(part.length, np.uint8)) for part in plan.vectors[group]]
        self._status = plan.status[SENDERS[group]]
        self._heartbeat, self._since = heartbeat, 0
        self._told: tuple[int, int, int] | None = None
        self._tick, self._ticks = -1, 0  # sent last; for how many more it is said with the values
        self.saturated = 0  # values that lay outside 16 bits

    def fits(self, message: bytes) -> bool:
        """Whether a message is a frame of this vector."""
        head = self._empty[:4]  # magic, version, data id
        return len(message) == len(self._empty) and message[:4] == head

    def frames(self, message: bytes) -> list[CanFrame]:
        """The CAN frames of a frame of the bench, in the order in which to send them."""
        *_, state, reason, _, sequence, tick = self._header.unpack_from(message)
        values = np.frombuffer(message[self._at : -_CRC_BYTES], np.float64)
        told = (state, reason, (sequence - tick) & 0xFFFF_FFFF)
        good = message[-_CRC_BYTES:] == _crc(message[:-_CRC_BYTES])
        if good:
            self._ticks -= tick != self._tick and self._ticks > 0
            self._tick = tick
            if told != self._told:
                self._told, self._ticks = told, 2
        counter = sequence % _SEQUENCES | (told[2] & 1) * _LAG | (self._ticks > 0) * _MARK
        out: list[CanFrame] = []
        if good and (self._ticks > 0 or self._since >= self._heartbeat):
            out.append((self._status.number, self._state(counter, tick, *told[:2])))
            self._since = 0
        self._since += 1
        for part, payload in self._parts:
            self.saturated += pack_vector(
                values, part.index, part.start, part.scale, part.offset, part.data_id,
                counter, payload,
            )  # fmt: skip
            if not good:  # damaged before it came here, and so it shall arrive
                payload[0] ^= 0xFF
            out.append((part.number, payload.tobytes()))
        return out

    def _state(self, counter: int, tick: int, state: int, reason: int) -> bytes:
        record = np.zeros(1, self._status.dtype)
        record["State"], record["Reason"] = state, reason
        record["Tick"], record[COUNTER] = tick & 0xFFFF_FFFF, counter
        record[CRC] = crc8(self._status.data_id, record.view(np.uint8))
        return record.tobytes()


class VectorReceiver:
    """Makes the frames of the bench again.

    Args:
        plan, group: as of the sender.
    """

    def __init__(self, plan: Plan, group: Group) -> None:
        self._header, self._empty, self._at = _header(group)
        self._magic = self._header.unpack_from(self._empty)[:3]
        self._values = np.zeros(len(names(group)))
        self._parts = {part.number: (k, part) for k, part in enumerate(plan.vectors[group])}
        self._status = plan.status[SENDERS[group]]
        self._sequence, self._lag = -1, 0  # of the newest frame
        self._said, self._told = -1, (0, 0)  # the newest state: its sequence, and what it says
        self._counter, self._have = -1, 0  # of the vector being put together, and its parts
        self.incomplete = 0  # vectors of which a part or the state never came

    def knows(self, number: int) -> bool:
        """Whether an identifier is one of this vector or its sender's state."""
        return number in self._parts or number == self._status.number

    def take(self, number: int, payload: bytes) -> bytes | None:
        """A CAN frame of this vector: the bench's frame that it completes, if it does."""
        k, layout = self._parts.get(number, (-1, self._status))
        data = np.frombuffer(payload, np.uint8)
        if len(data) != layout.length or data[0] != crc8(layout.data_id, data):
            return self._empty  # its CRC is 0, which is wrong
        if k < 0:
            self._learn(data.view(layout.dtype)[0])
            return None
        return self._put(k, layout, data)

    def _learn(self, status: np.void) -> None:
        sequence = self._count_on(int(status[COUNTER]))
        if sequence < self._sequence:
            return
        tick = self._sequence - self._lag
        tick += (int(status["Tick"]) - tick + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000
        self._lag, self._said = sequence - tick, sequence
        self._told = int(status["State"]), int(status["Reason"])

    def _count_on(self, counter: int) -> int:
        """The whole sequence of which the low bits came."""
        ahead = (counter - self._sequence + _BEHIND) % _SEQUENCES - _BEHIND
        return self._sequence + ahead

    def _put(self, k: int, layout: Layout, data: np.ndarray) -> bytes | None:
        counter = int(data[1])
        if counter != self._counter:
            self.incomplete += self._have != 0
            self._counter, self._have = counter, 0
        unpack_vector(data, layout.index, layout.start, layout.scale, layout.offset, self._values)
        self._have |= 1 << k
        if self._have != (1 << len(self._parts)) - 1:
            return None
        self._have = 0
        sequence, lag = self._count_on(counter), self._lag
        marked = counter & _MARK and sequence != self._said
        if marked or bool(counter & _LAG) != bool(lag & 1):  # its tick is not known
            self.incomplete += 1
            return None
        self._sequence = max(self._sequence, sequence)
        body = self._header.pack(
            *self._magic, *self._told, 0, sequence & 0xFFFF_FFFF, max(sequence - lag, 0)
        ) + self._values.tobytes()  # fmt: skip
        return body + _crc(body)


def _crc(body: bytes) -> bytes:
    return zlib.crc32(body).to_bytes(_CRC_BYTES, "little")
