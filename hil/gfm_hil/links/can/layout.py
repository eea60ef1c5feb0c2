"""Where each value lies in each frame, from a loaded DBC.

cantools reads the DBC once, at the start; the loop never calls it.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from cantools.database.can import Database, Message

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.dbc import (
    COUNTER,
    CRC,
    INNER,
    STATUS,
    TRANSPORT,
    VECTORS,
    read_dbc,
    write_dbc,
)
from gfm_runtime.regular import read_regular
from gfm_runtime.signals import PLAIN, VectorName, carried

_MOST_BYTES = 16 << 20  # of a DBC file


#: a value in a frame: its index in the vector, its first byte, and value = count × scale + offset
VALUE = [("index", "i8"), ("start", "i8"), ("scale", "f8"), ("offset", "f8")]


@dataclass(frozen=True)
class Layout:
    """One frame of the DBC."""

    # name, number, length: as in the DBC; the length in bytes
    name: str
    number: int
    length: int
    signals: dict[str, tuple[int, int]]  # first byte and number of bytes of each
    data_id: int  # 16 bits of a hash over the whole definition
    # the elements of the vector that it carries, records of ``VALUE``; none in other frames
    values: np.ndarray


@dataclass(frozen=True)
class Plan:
    """The frames of a DBC that a run uses."""

    # the frames of each vector, in the order of their identifiers
    vectors: dict[VectorName, list[Layout]]
    status: dict[Role, Layout]  # the frame of each sender
    transport: dict[Role, int]  # the identifier of each sender's ISO-TP frames
    # hash of all definitions, in a run without an inner stage less the frames of such a stage; both
    # sides compare it
    digest: int
    fd: bool  # CAN FD rather than classic
    signal_set: int = PLAIN  # of the vectors


def _definition(message: Message) -> str:
    signals = sorted(
        (s.name, s.start, s.length, s.byte_order, s.is_signed, float(s.scale), float(s.offset))
        for s in message.signals
    )
    return repr((message.name, message.frame_id, message.length, message.is_fd, signals))


def _digest(text: str, size: int) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:size], "little")


def _layout(message: Message, vector: tuple[str, ...] = ()) -> Layout:
    """The layout of a frame. Raises ValueError: a signal is not made of whole bytes, little-endian,
    or a value of the vector not of two, with a sign."""
    values = []
    for s in message.signals:
        if s.start % 8 or s.length not in (8, 16, 32) or s.byte_order != "little_endian":
            raise ValueError(
                f"{message.name}.{s.name}: must be 1, 2 or 4 whole bytes, little-endian"
            )
        if s.name in vector:
            if s.length != 16 or not s.is_signed:
                raise ValueError(f"{message.name}.{s.name}: must be a signed 16-bit value")
            values.append((vector.index(s.name), s.start // 8, float(s.scale), float(s.offset)))
    signals = {s.name: (s.start // 8, s.length // 8) for s in message.signals}
    return Layout(
        message.name, message.frame_id, message.length, signals,
        _digest(_definition(message), 2), np.array(sorted(values), VALUE),
    )  # fmt: skip


def _frames_of(title: str, messages: Mapping[str, Message]) -> list[Message]:
    found = [m for name, m in messages.items() if name == title or name.startswith(f"{title}_")]
    return sorted(found, key=lambda m: m.frame_id)


def plan_of(database: Database, signal_set: int = PLAIN) -> Plan:
    """The frames of a DBC that the link uses in a run with that signal set. Raises ValueError: a
    frame or a signal is missing or misplaced."""
    messages = {m.name: m for m in database.messages}
    missing = sorted({*STATUS.values(), *TRANSPORT.values()} - set(messages))
    if missing:
        raise ValueError(f"frames {missing} are missing")
    vectors: dict[VectorName, list[Layout]] = {}
    for group, title in (INNER if signal_set else VECTORS).items():
        wanted = carried(group, signal_set)
        vectors[group] = [_layout(m, wanted) for m in _frames_of(title, messages)]
        found = sorted(k for layout in vectors[group] for k in layout.values["index"].tolist())
        if found != list(range(len(wanted))):
            why = "; this run has an inner stage" if signal_set else ""
            raise ValueError(f"frames {title}…: must carry each of {list(wanted)} once{why}")
    others = () if signal_set else INNER.values()
    unused = {m.name for title in others for m in _frames_of(title, messages)}
    defined = [_definition(m) for m in database.messages if m.name not in unused]
    plan = Plan(
        vectors,
        {role: _layout(messages[STATUS[role]]) for role in ROLES},
        {role: messages[TRANSPORT[role]].frame_id for role in ROLES},
        _digest("".join(sorted(defined)), 4),
        any(m.is_fd for m in database.messages),
        signal_set,
    )
    for layout in [*vectors["y"], *vectors["u"], *plan.status.values()]:
        if [layout.signals.get(name, (-1,))[0] for name in (CRC, COUNTER)] != [0, 1]:
            raise ValueError(f"{layout.name}: must begin with {CRC} and {COUNTER}")
    return plan


@cache
def load_plan(options: CanOptions) -> Plan:
    """The frames of the DBC that the options name, or of the generated one. Raises ValueError: the
    DBC cannot be read, or lacks what the link needs."""
    if options.dbc is None:
        return plan_of(read_dbc(write_dbc(options.fd)), options.signal_set)
    where = f"dbc = {options.dbc!r}"
    try:
        text = read_regular(options.dbc, _MOST_BYTES).decode("utf-8")
        plan = plan_of(read_dbc(text), options.signal_set)
    except OSError as problem:
        raise ValueError(f"{where}: {problem.strerror}") from None
    except Exception as problem:  # cantools' parser errors have no common base class
        said = " ".join(str(problem).split())
        raise ValueError(f"{where}: {said}") from None
    if plan.fd != options.fd:
        kind = "CAN FD" if plan.fd else "classic CAN"
        raise ValueError(f"{where}: describes {kind}; link.options.fd must agree")
    return plan
