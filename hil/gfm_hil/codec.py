"""Packing and checking frames, compiled: the one implementation that both kinds of loop use.

The layout is ``gfm_hil.frames.frame_dtype``.
"""

from __future__ import annotations

import numpy as np

from gfm_hil.crc import crc32
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import TABLE_VERSION

MAGIC = 0x4647  # "GF"

FAULTS = ("size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence")
SIZE, BAD_MAGIC, VERSION, SOURCE, CRC, REPEATED, LOST, OUT_OF_SEQUENCE = range(len(FAULTS))

#: what a reader knows; ``fault`` is that of the frame last refused
reader_dtype = np.dtype(
    [
        ("faults", "i8", (len(FAULTS),)),
        ("next", "i8"),  # sequence expected
        ("tick", "i8"),  # of the last good frame, -1 before the first
        ("state", "i8"),
        ("reason", "i8"),
        ("fault", "i8"),
    ],
    align=True,
)

_CRC_BYTES = 4  # at the end
_WRAP = 0x1_0000_0000
_HEADER = (
    ("magic", "<u2"),
    ("version", "u1"),
    ("data_id", "u1"),
    ("state", "u1"),
    ("reason", "u1"),
    ("spare", "<u2"),
    ("sequence", "<u4"),
    ("tick", "<u8"),
)


def wire_dtype(count: int) -> np.dtype:
    """A frame of ``count`` values as it travels."""
    return np.dtype([*_HEADER, ("values", "<f8", (count,)), ("crc", "<u4")])


def buffer(count: int, data_id: int) -> tuple[np.ndarray, np.ndarray]:
    """A frame of our own: one record of ``wire_dtype`` and the same memory as bytes."""
    frame = np.zeros(1, wire_dtype(count))
    frame["magic"], frame["version"], frame["data_id"] = MAGIC, TABLE_VERSION, data_id
    return frame, frame.view(np.uint8)


def make_reader() -> np.ndarray:
    """A reader that has seen nothing yet."""
    reader = np.zeros(1, reader_dtype)
    reader["tick"] = -1
    return reader


@inlined
def pack(sequence, frame, message, tick, state, reason, values):
    """Fill a frame and count its sequence on.

    Args:
        sequence: of this frame, shape (1,), int64.
        frame, message: a buffer as one record of ``wire_dtype`` and as bytes; magic, version and
            data id are set.
        tick, state, reason: of the sender.
        values: p.u., in the order of the signal table.
    """
    f = frame[0]
    if f.state != state or f.reason != reason:  # a store just before the CRC reads it holds that up
        f.state, f.reason = state, reason
    f.tick = tick
    f.sequence = sequence[0]
    sequence[0] = (sequence[0] + 1) % _WRAP
    for j in range(len(values)):
        f.values[j] = values[j]
    f.crc = crc32(message, len(message) - _CRC_BYTES)


@inlined
def unpack(reader, data_id, frame, message, size, values):
    """Check a frame and take its values.

    Args:
        reader: one-element array of ``reader_dtype``.
        data_id: the frame's that is expected.
        frame, message: a buffer as one record of ``wire_dtype`` and as bytes; ``size`` were
            received, which may be more than it holds.
        values: written only if the frame is good.

    Returns:
        The frame's tick, or -1 if it was refused and counted.
    """
    r, f = reader[0], frame[0]
    fault = -1
    ahead = (np.int64(f.sequence) - r.next) % _WRAP
    if size != len(message):
        fault = SIZE
    elif f.crc != crc32(message, size - _CRC_BYTES):
        fault = CRC
    elif f.magic != MAGIC:
        fault = BAD_MAGIC
    elif f.version != TABLE_VERSION:
        fault = VERSION
    elif f.data_id != data_id:
        fault = SOURCE
    elif ahead >= _WRAP // 2:
        fault = REPEATED if ahead == _WRAP - 1 else OUT_OF_SEQUENCE
    if fault >= 0:
        r.faults[fault] += 1
        r.fault = fault
        return -1
    r.faults[LOST] += ahead
    r.next = (np.int64(f.sequence) + 1) % _WRAP
    r.tick, r.state, r.reason = np.int64(f.tick), f.state, f.reason
    for j in range(len(values)):
        values[j] = f.values[j]
    return r.tick
