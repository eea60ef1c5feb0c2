"""Packing and checking frames, compiled: Python and the compiled loops use the same functions.

``frame_dtype`` gives the layout.
"""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from gfm_hil.links.crc import crc32
from gfm_hil.realtime.atomics import load32, store32
from gfm_runtime.compiled import inlined
from gfm_runtime.signals import NU_COUNTS, NY_MOST, PLAIN, TABLE_VERSION, VectorName, carried
from gfm_runtime.states import REASONS, SAFE, STOPPED

MAGIC = 0x4647  # "GF"

Fault = Literal[
    "size", "magic", "version", "source", "crc", "repeated", "lost", "out_of_sequence", "tick",
    "state",
]  # fmt: skip
FAULTS: tuple[Fault, ...] = get_args(Fault)
(
    SIZE, BAD_MAGIC, VERSION, SOURCE, CRC, REPEATED, LOST, OUT_OF_SEQUENCE, TICK, STATE,
) = range(len(FAULTS))  # fmt: skip

#: the state of the end-to-end protection (E2E): no good frame yet; good frames with newer ticks
#: arrive; none arrived for too long
E2E = ("initial", "valid", "invalid")
INITIAL, VALID, INVALID = range(len(E2E))

#: the state of a reader, and the limits within which it accepts a frame
reader_dtype = np.dtype(
    [
        ("faults", "i8", (len(FAULTS),)),
        ("fault", "i8"),  # of the last refused frame
        ("e2e", "i8"),
        ("next", "i8"),  # sequence expected
        ("tick", "i8"),  # of the last good frame, -1 before the first
        ("repeats", "i8"),  # how often that tick was repeated
        ("state", "i8"),
        ("reason", "i8"),
        # the limits
        ("newest", "i8"),  # highest tick that a running peer can have reached
        ("behind", "i8"),  # how many ticks below ``newest`` its frame may be
        ("delta", "i8"),  # how many ticks it may advance from one good frame to the next
        ("jump", "i8"),  # how many frames in a row may be missing
        ("again", "i8"),  # how often it may repeat a tick
        ("leaving", "i8"),  # lowest state that says that the peer leaves
        ("every", "i8"),  # ticks to a frame; the sequence counts ticks and repeats
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
#: what comes before the values
header_dtype = np.dtype([*_HEADER])


def wire_dtype(count: int) -> np.dtype:
    """The layout of a frame of ``count`` values on the link."""
    return np.dtype([*_HEADER, ("values", "<f8", (count,)), ("crc", "<u4")])


#: a frame's memory as compiled functions see it: with room for the longest vector, so that they are
#: compiled once for frames of all lengths
_LONGEST = max(NY_MOST, NU_COUNTS)
record_dtype = np.dtype([*_HEADER, ("values", "<f8", (_LONGEST,)), ("room", "<u4")])


def buffer(count: int, data_id: int) -> tuple[np.ndarray, np.ndarray]:
    """Memory for one frame: a record of ``record_dtype``, and the frame's bytes in it."""
    frame = np.zeros(1, record_dtype)
    frame["magic"], frame["version"], frame["data_id"] = MAGIC, TABLE_VERSION, data_id
    return frame, frame.view(np.uint8)[: wire_dtype(count).itemsize]


def make_reader() -> np.ndarray:
    """A reader in its initial state that limits neither ticks nor missing frames."""
    reader = np.zeros(1, reader_dtype)
    reader["tick"], reader["leaving"], reader["every"] = -1, SAFE, 1
    for limit in ("newest", "behind", "delta", "again"):
        reader[limit] = _NO_LIMIT
    reader["jump"] = LONGEST_JUMP
    return reader


@inlined
def pack(sequence, frame, message, tick, state, reason, values):
    """Fill a frame and increment the sequence counter.

    Args:
        sequence: counter with the number of this frame, shape (1,), int64.
        frame, message: of a ``buffer``; magic, version and data id are set.
        tick, state, reason: of the sender.
        values: p.u., in the order of the signal table.
    """
    f = frame[0]
    if f.state != state or f.reason != reason:  # a store right before the CRC's load stalls it
        f.state, f.reason = state, reason
    f.tick = tick
    for j in range(len(values)):
        f.values[j] = values[j]
    pack_again(sequence, frame, message)


@inlined
def pack_again(sequence, frame, message):
    """Number the buffer's last frame anew, to send it once more: what it says stays the same,
    whatever the sender has done since."""
    f = frame[0]
    f.sequence = sequence[0]
    skip(sequence)
    seal(message)


@inlined
def seal(message):
    """Write the CRC that ends a frame."""
    store32(_seal_at(message), crc32(message, len(message) - _CRC_BYTES))


@inlined
def is_sealed(message):
    """Whether a frame ends with its CRC."""
    return load32(_seal_at(message)) == crc32(message, len(message) - _CRC_BYTES)


@inlined
def _seal_at(message):
    return message.ctypes.data + len(message) - _CRC_BYTES


@inlined
def skip(sequence):
    """Leave out a number: of a tick without an exchange."""
    sequence[0] = (sequence[0] + 1) % _WRAP


@inlined
def unpack(reader, data_id, frame, message, size, values):
    """Check a frame and take its values.

    A refused frame changes nothing but the reader's counters. The tick of a good frame never goes
    back. A peer that leaves says so with its last tick or the next one, however far the reader has
    advanced since.

    Args:
        reader: one-element array of ``reader_dtype``.
        data_id: of the expected frame.
        frame, message: of a ``buffer``.
        size: bytes received, which may be more than the buffer holds.
        values: written only if the frame is good and its tick newer: the first good frame of a
            tick stands.

    Returns:
        The frame's tick, or -1 if it was refused and counted.
    """
    r, f = reader[0], frame[0]
    fault = -1
    ahead = (np.int64(f.sequence) - r.next) % _WRAP
    if size != len(message):
        fault = SIZE
    elif not is_sealed(message):
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
    tick = np.int64(f.tick)
    if ahead > 0:
        passed = tick - max(r.tick, 0)
        r.faults[LOST] += max(0, ahead - (passed - passed // r.every))
    r.next = (np.int64(f.sequence) + 1) % _WRAP
    if tick > r.tick:
        for j in range(len(values)):
            values[j] = f.values[j]
        r.repeats = 0
        if r.e2e == INITIAL:
            r.e2e = VALID
    else:
        r.repeats += 1
    r.tick, r.state, r.reason = tick, f.state, f.reason
    return tick


@inlined
def _implausible(r, tick, leaves):
    """Whether the peer cannot be at that tick; a tick of 2**63 or more is negative here."""
    if tick < 0 or tick < r.tick or tick - max(r.tick, 0) > r.delta:
        return True
    if leaves:
        return tick - 1 > r.newest
    if tick == r.tick and r.repeats >= r.again:
        return True
    return tick > r.newest or tick < r.newest - r.behind


@inlined
def judge(reader, overdue, latched):
    """Update the E2E state between frames; ``unpack`` updates it when a frame arrives.

    Args:
        reader: one-element array of ``reader_dtype``.
        overdue: no newer good frame has arrived for longer than the caller allows.
        latched: the caller is in its safe state, or tripped; INVALID then stays until a reset.
    """
    if overdue:
        reader[0].e2e = INVALID
    elif reader[0].e2e == INVALID and not latched:
        reader[0].e2e = INITIAL


LAST_TIMES = 3  # how often a side sends its last frame, which says that it leaves

DATA_IDS: dict[VectorName, int] = {"y": 1, "u": 2}


class FrameError(ValueError):
    """A frame that must not be used; ``fault`` names the check that it failed."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault)
        self.fault = fault


def frame_dtype(group: VectorName, signal_set: int = PLAIN) -> np.dtype:
    """The layout as a NumPy record with one field per signal, for tools that read recordings."""
    wire = wire_dtype(len(carried(group, signal_set)))
    fields = [(name, wire[name]) for name in wire.names or () if name not in ("values", "crc")]
    values = [(name, "<f8") for name in carried(group, signal_set)]
    return np.dtype([*fields, *values, ("crc", "<u4")])


class FrameWriter:
    """Packs one side's vector and keeps its sequence counter.

    Args:
        group: ``"y"`` or ``"u"``.
        signal_set: what follows the vector in the frame, see ``carried_rows``.
    """

    def __init__(self, group: VectorName, signal_set: int = PLAIN) -> None:
        self.sequence = np.zeros(1, np.int64)
        self.frame, self.message = buffer(len(carried(group, signal_set)), DATA_IDS[group])

    def pack(self, tick: int, state: int, reason: int, values: NDArray[np.float64]) -> bytes:
        """One frame; ``values`` has the shape of the group, p.u."""
        pack(self.sequence, self.frame, self.message, tick, state, reason, values)
        return self.message.tobytes()


class FrameReader:
    """Unpacks the other side's vector and counts every frame that fails a check, by its fault.

    The reader counts a gap in the sequence as that many ``lost`` frames and uses the frame. It
    refuses a frame that is not newer than the last as ``repeated`` or ``out_of_sequence``, a frame
    whose tick the sender cannot be at as ``tick``, and one with an undefined state or reason byte
    as ``state``.

    Args:
        group: ``"y"`` or ``"u"``.
        signal_set: as for ``FrameWriter``.
        limits: fields of ``reader_dtype``; without them the reader limits neither the tick nor
            the gap.
    """

    def __init__(self, group: VectorName, signal_set: int = PLAIN, **limits: int) -> None:
        self.group = group
        self.record = make_reader()
        for name, limit in limits.items():
            self.record[name] = limit
        self.data_id = DATA_IDS[group]
        self.frame, self.message = buffer(len(carried(group, signal_set)), self.data_id)

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
    def e2e(self) -> str:
        """State of the end-to-end protection, one of ``gfm_hil.links.frame.E2E``."""
        return E2E[int(self.record["e2e"][0])]

    def unpack(self, message: bytes, values: NDArray[np.float64]) -> int:
        """Write the values of a good frame with a newer tick into ``values``; returns its tick.
        Raises FrameError: the frame failed a check; the reader has counted it, and ``values`` is
        unchanged."""
        size = len(message)
        if size == len(self.message):
            self.message[:] = np.frombuffer(message, np.uint8)
        tick = unpack(self.record, self.data_id, self.frame, self.message, size, values)
        if tick < 0:
            raise FrameError(FAULTS[int(self.record["fault"][0])])
        return int(tick)
