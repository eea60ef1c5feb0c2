"""A CAN frame as Linux has it, ``struct canfd_frame`` of linux/can.h: in memory and as a datagram.

A datagram ends with the last byte of data; SocketCAN wants whole structures.
"""

from __future__ import annotations

import struct
import time

import can
import numpy as np

frame_dtype = np.dtype(
    [("id", "u4"), ("length", "u1"), ("flags", "u1"), ("reserved", "u1", (2,)), ("data", "u1", 64)]
)
HEAD = 8  # bytes before the data
MTU, MTU_FD = 16, 72  # bytes of struct can_frame, which begins alike, and of canfd_frame

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
