"""The frame that crosses a link: one message, one frame, fixed size, checked.

Little-endian: a header (magic, table version, data id, sender's state, reason, spare, sequence,
tick), the float64 values of one vector in the order of the signal table, and a CRC-32 over all
before it. Two data ids exist: y (plant to controller) and u (controller to plant).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.signals import TABLE_VERSION, Group, names

MAGIC = 0x4647  # "GF"
HEADER = "<HBBBBHIQ"
DATA_IDS: dict[Group, int] = {"y": 1, "u": 2}

Fault = Literal["size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence"]
FAULTS: tuple[Fault, ...] = (
    "size",
    "magic",
    "version",
    "source",
    "crc",
    "repeated",
    "lost",
    "out_of_sequence",
)


class FrameError(ValueError):
    """A frame that must not be used; ``fault`` says which check it failed."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        self.fault = fault


def _layout(group: Group) -> struct.Struct:
    return struct.Struct(f"{HEADER}{len(names(group))}dI")


def frame_dtype(group: Group) -> np.dtype:
    """The same layout as a NumPy record, for tools that read recorded frames."""
    header = ["magic", "version", "data_id", "state", "reason", "spare", "sequence", "tick"]
    kinds = ["<u2", "u1", "u1", "u1", "u1", "<u2", "<u4", "<u8"]
    values = [(name, "<f8") for name in names(group)]
    return np.dtype([*zip(header, kinds, strict=True), *values, ("crc", "<u4")])


class FrameWriter:
    """Packs one side's vector; counts its own sequence.

    Args:
        group: ``"y"`` or ``"u"``.
    """

    def __init__(self, group: Group) -> None:
        self._struct, self._id = _layout(group), DATA_IDS[group]
        self._sequence = 0
        self._buffer = bytearray(self._struct.size)
        self._body = memoryview(self._buffer)[:-4]

    def pack(self, tick: int, state: int, reason: int, values: NDArray[np.float64]) -> bytes:
        """One frame; ``values`` has the shape of the group, p.u."""
        self._struct.pack_into(
            self._buffer, 0, MAGIC, TABLE_VERSION, self._id, state, reason, 0,
            self._sequence & 0xFFFFFFFF, tick, *values.tolist(), 0,
        )  # fmt: skip
        struct.pack_into("<I", self._buffer, len(self._body), zlib.crc32(self._body))
        self._sequence += 1
        return bytes(self._buffer)


@dataclass
class FrameReader:
    """Unpacks the other side's vector and counts every frame that fails a check, by its fault.

    A gap in the sequence is counted as that many ``lost`` frames, and the frame is used; a frame
    that is not newer than the last is ``repeated`` or ``out_of_sequence`` and is refused.
    """

    group: Group
    faults: dict[Fault, int] = field(default_factory=lambda: dict.fromkeys(FAULTS, 0))
    tick: int = -1
    state: int = 0
    reason: int = 0
    _next: int = 0

    def __post_init__(self) -> None:
        self._struct, self._id = _layout(self.group), DATA_IDS[self.group]

    def unpack(self, frame: bytes, values: NDArray[np.float64]) -> int:
        """Write the values of a good frame into ``values``; returns its tick.

        Raises:
            FrameError: the frame failed a check, was counted, and ``values`` is unchanged.
        """
        if len(frame) != self._struct.size:
            self._refuse("size")
        magic, version, data_id, state, reason, _, sequence, tick, *payload, crc = (
            self._struct.unpack(frame)
        )
        if crc != zlib.crc32(frame[:-4]):
            self._refuse("crc")
        if magic != MAGIC:
            self._refuse("magic")
        if version != TABLE_VERSION:
            self._refuse("version")
        if data_id != self._id:
            self._refuse("source")
        ahead = (sequence - self._next) & 0xFFFFFFFF
        if ahead >= 0x80000000:
            self._refuse("repeated" if ahead == 0xFFFFFFFF else "out_of_sequence")
        self.faults["lost"] += ahead
        self._next = (sequence + 1) & 0xFFFFFFFF
        values[:] = payload
        self.tick, self.state, self.reason = tick, state, reason
        return int(tick)

    def _refuse(self, fault: Fault) -> None:
        self.faults[fault] += 1
        raise FrameError(fault)
