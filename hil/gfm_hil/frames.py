"""The frame that crosses a link: one message, one frame, fixed size, checked.

Little-endian: a header (magic, table version, data id, sender's state, reason, spare, sequence,
tick), the float64 values of one vector in the order of the signal table, and a CRC-32 over all
before it. Two data ids exist: y (plant to controller) and u (controller to plant).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.codec import E2E, LONGEST_JUMP, buffer, judge, make_reader, pack, unpack, wire_dtype
from gfm_hil.codec import FAULTS as FAULT_NAMES
from gfm_runtime.controller import STOPPED
from gfm_runtime.signals import Group, names

if TYPE_CHECKING:
    from gfm_hil.links.base import Side
    from gfm_hil.scenario import Scenario

LAST_TIMES = 3  # how often a side sends the frame by which it leaves

DATA_IDS: dict[Group, int] = {"y": 1, "u": 2}

Fault = Literal[
    "size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence", "tick",
    "state",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = FAULT_NAMES  # type: ignore[assignment]


class FrameError(ValueError):
    """A frame that must not be used; ``fault`` says which check it failed."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        self.fault = fault


def frame_dtype(group: Group) -> np.dtype:
    """The layout as a NumPy record with a field a signal, for tools that read recorded frames."""
    wire = wire_dtype(len(names(group)))
    fields = [(name, wire[name]) for name in wire.names or () if name not in ("values", "crc")]
    return np.dtype([*fields, *((name, "<f8") for name in names(group)), ("crc", "<u4")])


class FrameWriter:
    """Packs one side's vector; counts its own sequence.

    Args:
        group: ``"y"`` or ``"u"``.
    """

    def __init__(self, group: Group) -> None:
        self.sequence = np.zeros(1, np.int64)
        self.frame, self.message = buffer(len(names(group)), DATA_IDS[group])

    def pack(self, tick: int, state: int, reason: int, values: NDArray[np.float64]) -> bytes:
        """One frame; ``values`` has the shape of the group, p.u."""
        pack(self.sequence, self.frame, self.message, tick, state, reason, values)
        return self.message.tobytes()


class FrameReader:
    """Unpacks the other side's vector and counts every frame that fails a check, by its fault.

    A gap in the sequence is counted as that many ``lost`` frames, and the frame is used; a frame
    that is not newer than the last is ``repeated`` or ``out_of_sequence`` and is refused. A frame
    whose tick the sender cannot be at is refused as ``tick``, one whose state or reason byte has
    no meaning as ``state``.

    Args:
        group: ``"y"`` or ``"u"``. Without ``of``, the reader limits neither the tick nor the gap.
    """

    @classmethod
    def of(cls, side: Side, scenario: Scenario) -> FrameReader:
        """The reader of one side, with the limits that its scenario sets.

        A gap of more ticks than ``link.peer_timeout_s`` has is that of a peer that is gone. The
        plant's loop writes its own tick into ``newest`` at every tick.
        """
        reader, link = cls("u" if side == "plant" else "y"), scenario.link
        lockstep, r = scenario.mode == "lockstep", reader.record
        r["delta"] = math.ceil(link.peer_timeout_s / scenario.T_s) + 1
        asked = math.ceil(min(link.peer_timeout_s / link.repeat_s, LONGEST_JUMP))
        r["jump"] = min(int(r["delta"][0]) + asked + LAST_TIMES, LONGEST_JUMP)
        r["again"] = asked if lockstep else 0
        if side == "controller":
            r["newest"] = scenario.ticks - 1
        elif not lockstep:
            r["behind"] = scenario.late_policy.hold
        if scenario.after_trip == "wait":
            r["leaving"] = STOPPED
        return reader

    def __init__(self, group: Group) -> None:
        self.group = group
        self.record = make_reader()
        self.data_id = DATA_IDS[group]
        self.frame, self.message = buffer(len(names(group)), self.data_id)

    @property
    def faults(self) -> dict[Fault, int]:
        """Frames refused or missing so far, by fault."""
        return dict(zip(FAULTS, self.record["faults"][0].tolist(), strict=True))

    @property
    def tick(self) -> int:
        """Tick of the last good frame, -1 before the first."""
        return int(self.record["tick"][0])

    @property
    def state(self) -> int:
        """The sender's state in the last good frame."""
        return int(self.record["state"][0])

    @property
    def reason(self) -> int:
        """The sender's reason in the last good frame."""
        return int(self.record["reason"][0])

    @property
    def left(self) -> bool:
        """The last good frame said that its sender leaves."""
        return bool(self.record["state"][0] >= self.record["leaving"][0])

    @property
    def e2e(self) -> str:
        """State of the end-to-end protection, one of ``gfm_hil.codec.E2E``."""
        return E2E[int(self.record["e2e"][0])]

    def judge(self, overdue: bool, latched: bool) -> None:
        """Move the E2E state on; see ``gfm_hil.codec.judge``."""
        judge(self.record, bool(overdue), bool(latched))

    def unpack(self, message: bytes, values: NDArray[np.float64]) -> int:
        """Write the values of a good frame into ``values``; returns its tick.

        Raises:
            FrameError: the frame failed a check, was counted, and ``values`` is unchanged.
        """
        size = len(message)
        if size == len(self.message):
            self.message[:] = np.frombuffer(message, np.uint8)
        tick = unpack(self.record, self.data_id, self.frame, self.message, size, values)
        if tick < 0:
            raise FrameError(FAULTS[int(self.record["fault"][0])])
        return int(tick)
