"""Packing and checking frames, compiled: the one implementation that both kinds of loop use.

The layout is ``gfm_hil.links.frame.frame_dtype``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.links.crc import crc32
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import TABLE_VERSION, Group, names
from gfm_runtime.states import REASONS, SAFE, STOPPED

MAGIC = 0x4647  # "GF"

Fault = Literal[
    "size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence", "tick",
    "state",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = (
    "size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence", "tick",
    "state",
)  # fmt: skip
(
    SIZE, BAD_MAGIC, VERSION, SOURCE, CRC, REPEATED, LOST, OUT_OF_SEQUENCE, TICK, STATE,
) = range(len(FAULTS))  # fmt: skip

#: the state of the end-to-end protection (E2E): no good frame yet; good frames with newer ticks
#: come; for too long none came
E2E = ("initial", "valid", "invalid")
INITIAL, VALID, INVALID = range(len(E2E))

#: what a reader knows, and the limits within which it accepts a frame
reader_dtype = np.dtype(
    [
        ("faults", "i8", (len(FAULTS),)),
        ("fault", "i8"),  # of the frame last refused
        ("e2e", "i8"),
        ("next", "i8"),  # sequence expected
        ("tick", "i8"),  # of the last good frame, -1 before the first
        ("repeats", "i8"),  # how often that tick came again
        ("state", "i8"),
        ("reason", "i8"),
        # the limits
        ("newest", "i8"),  # the highest tick that a peer which runs can be at
        ("behind", "i8"),  # how many ticks below ``newest`` its frame may be
        ("delta", "i8"),  # how many ticks it may advance from one good frame to the next
        ("jump", "i8"),  # how many frames in a row may be missing
        ("again", "i8"),  # how often it may send one tick again
        ("leaving", "i8"),  # the lowest state by which the peer says that it leaves
    ],
    align=True,
)

_CRC_BYTES = 4  # at the end
_WRAP = 0x1_0000_0000
LONGEST_JUMP = _WRAP // 2 - 1  # beyond it a sequence counts as older
_NO_LIMIT = 2**63 - 1
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
    """A reader that has seen nothing yet and limits neither ticks nor missing frames."""
    reader = np.zeros(1, reader_dtype)
    reader["tick"], reader["leaving"] = -1, SAFE
    for limit in ("newest", "behind", "delta", "again"):
        reader[limit] = _NO_LIMIT
    reader["jump"] = LONGEST_JUMP
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

    A refused frame leaves all but the counters of the reader as it was. The tick of a good frame
    never goes back. A peer that leaves says so under its last tick or the next one, however far
    the reader has gone on since.

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
    elif ahead > r.jump:
        fault = REPEATED if ahead == _WRAP - 1 else OUT_OF_SEQUENCE
    elif f.state > STOPPED or f.reason >= len(REASONS):
        fault = STATE
    elif _implausible(r, np.int64(f.tick), f.state >= r.leaving):
        fault = TICK
    if fault >= 0:
        r.faults[fault] += 1
        r.fault = fault
        return -1
    r.faults[LOST] += ahead
    r.next = (np.int64(f.sequence) + 1) % _WRAP
    tick = np.int64(f.tick)
    if tick > r.tick:
        r.repeats = 0
        if r.e2e == INITIAL:
            r.e2e = VALID
    else:
        r.repeats += 1
    r.tick, r.state, r.reason = tick, f.state, f.reason
    for j in range(len(values)):
        values[j] = f.values[j]
    return tick


@inlined
def _implausible(r, tick, leaves):
    """Whether the peer cannot be at that tick; one of 2**63 or more arrives here as negative."""
    if tick < 0 or tick < r.tick or tick - max(r.tick, 0) > r.delta:
        return True
    if leaves:
        return tick - 1 > r.newest
    if tick == r.tick and r.repeats >= r.again:
        return True
    return tick > r.newest or tick < r.newest - r.behind


@inlined
def judge(reader, overdue, latched):
    """Move the E2E state on, apart from what ``unpack`` does when a frame comes.

    Args:
        reader: one-element array of ``reader_dtype``.
        overdue: no newer good frame came for longer than the caller allows.
        latched: the caller is in its safe state, or tripped; only a reset ends that, and with it
            INVALID.
    """
    if overdue:
        reader[0].e2e = INVALID
    elif reader[0].e2e == INVALID and not latched:
        reader[0].e2e = INITIAL


if TYPE_CHECKING:
    from gfm_hil.core.roles import Side
    from gfm_hil.scenario.model import Scenario

LAST_TIMES = 3  # how often a side sends the frame by which it leaves

DATA_IDS: dict[Group, int] = {"y": 1, "u": 2}


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
        """State of the end-to-end protection, one of ``gfm_hil.links.frame.E2E``."""
        return E2E[int(self.record["e2e"][0])]

    def judge(self, overdue: bool, latched: bool) -> None:
        """Move the E2E state on; see ``gfm_hil.links.frame.judge``."""
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
