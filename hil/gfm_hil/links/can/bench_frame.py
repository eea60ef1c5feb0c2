"""A frame of the bench as bytes, read and written where it lies, compiled."""

from __future__ import annotations

import numpy as np
from numba import njit

from gfm_hil.codec import buffer, wire_dtype
from gfm_hil.crc import crc32
from gfm_hil.frames import DATA_IDS
from gfm_runtime.signals import NU, NY, Group, names

VALUES = max(NY, NU)  # most of a vector
MOST = wire_dtype(VALUES).itemsize  # bytes


def _at(field: str) -> int:
    fields = wire_dtype(1).fields
    assert fields is not None
    return int(fields[field][1])


STATE, REASON, SPARE, SEQUENCE, TICK, FIRST = map(
    _at, ("state", "reason", "spare", "sequence", "tick", "values")
)
CRC_BYTES = 4  # at the end
_HEAD_BYTES = STATE  # magic, version, data id


def size_and_head(group: Group) -> tuple[int, int]:
    """What tells a vector's frames from other messages: their length and their first bytes."""
    _, message = buffer(len(names(group)), DATA_IDS[group])
    return len(message), int.from_bytes(message[:_HEAD_BYTES].tobytes(), "little")


@njit(cache=True, nogil=True)
def number(data, at, width):
    """The little-endian number of ``width`` bytes."""
    value = np.int64(0)
    for k in range(width):
        value |= np.int64(data[at + k]) << (8 * k)
    return value


@njit(cache=True, nogil=True)
def put_number(data, at, width, value):
    """Write the low ``width`` bytes of a number, little-endian."""
    for k in range(width):
        data[at + k] = (value >> (8 * k)) & 0xFF


@njit(cache=True, nogil=True)
def begins_with(head, message):
    """Whether a message that is long enough has these first bytes."""
    return number(message, 0, _HEAD_BYTES) == head


@njit(cache=True, nogil=True)
def undamaged(message, size):
    """Whether a frame of ``size`` bytes passes its check."""
    return crc32(message, size - CRC_BYTES) == number(message, size - CRC_BYTES, CRC_BYTES)


@njit(cache=True, nogil=True)
def seal(message, size):
    """Write the check of a frame of ``size`` bytes."""
    put_number(message, size - CRC_BYTES, CRC_BYTES, np.int64(crc32(message, size - CRC_BYTES)))
