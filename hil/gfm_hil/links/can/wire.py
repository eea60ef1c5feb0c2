"""A CAN frame as Linux defines it, ``struct canfd_frame`` of linux/can.h: in memory, as a datagram.

A datagram ends with the last data byte; SocketCAN requires whole structures.
"""

import struct
import time

import can
import numpy as np

from gfm_hil.links.frame import wire_dtype
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import NU_INNER, NY_INNER

frame_dtype = np.dtype(
    [("id", "u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "u1", (2,)), ("data", "u1", 64)]
)
HEAD = 8  # bytes before the data
MTU, MTU_FD = 16, 72  # bytes of struct can_frame, which begins the same way, and canfd_frame

#: flags in ``id``, above the identifier
EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
NUMBER = 0x1FFF_FFFF
BUS_OFF = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h, in an error frame's identifier
#: values of ``flags``
BRS, ESI, FD = 0x01, 0x02, 0x04

_HEAD = struct.Struct("=IBB2x")


def pack(message: can.Message) -> bytes:
    """A message of python-can as a datagram."""
    flags = message.is_fd and (
        FD | message.bitrate_switch * BRS | message.error_state_indicator * ESI
    )
    number = message.arbitration_id | (
        message.is_extended_id * EXTENDED
        | message.is_remote_frame * REMOTE
        | message.is_error_frame * ERROR
    )
    return _HEAD.pack(number, len(message.data), flags) + message.data


def unpack(datagram: bytes) -> can.Message:
    """The message of a datagram."""
    number, length, flags = _HEAD.unpack_from(datagram)
    return can.Message(
        timestamp=time.time(),
        arbitration_id=number & NUMBER,
        is_extended_id=bool(number & EXTENDED),
        is_remote_frame=bool(number & REMOTE),
        is_error_frame=bool(number & ERROR),
        is_fd=bool(flags & FD),
        bitrate_switch=bool(flags & BRS),
        error_state_indicator=bool(flags & ESI),
        data=datagram[HEAD : HEAD + length],
    )


_POLYNOMIAL = 0x1D


def _table() -> np.ndarray:
    table = np.zeros(256, np.uint8)
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x80 else 0)
        table[byte] = crc & 0xFF
    return table


_TABLE = _table()


@compiled
def crc8(data_id, payload):
    """CRC of byte 0 over the data id and ``payload[1:]``."""
    crc = _TABLE[0xFF ^ (data_id & 0xFF)]
    crc = _TABLE[crc ^ (data_id >> 8)]
    for k in range(1, len(payload)):
        crc = _TABLE[crc ^ payload[k]]
    return crc ^ 0xFF


VALUES = max(NY_INNER, NU_INNER)  # of the longest vector
MOST = wire_dtype(VALUES).itemsize  # bytes of the bench's longest frame


@compiled
def number(data, at, width):
    """The little-endian number of ``width`` bytes."""
    value = np.int64(0)
    for k in range(width):
        value |= np.int64(data[at + k]) << (8 * k)
    return value


@compiled
def put_number(data, at, width, value):
    """Write the low ``width`` bytes of a number, little-endian."""
    for k in range(width):
        data[at + k] = (value >> (8 * k)) & 0xFF
