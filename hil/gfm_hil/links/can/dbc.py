"""The DBC: all frames on the bus, generated from the signal table.

Every frame that carries values begins with two bytes of end-to-end protection, then values as
int16, little-endian. A value travels in counts of its ``scale``; -32768 stands for NaN.
CAN FD sends a vector in one frame, classic CAN in as many as it needs. A run with an inner stage
uses frames of its own, which carry that stage's signals after those of the vector. The lower
identifier wins the bus: states first, then commands, then measurements, then the handshake, whose
frames are those of ISO-TP and have no signals.
"""

from collections import OrderedDict
from typing import Any

from cantools.database import load_string
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.can.formats.dbc.dbc_attribute import DbcAttribute
from cantools.database.can.formats.dbc.dbc_attribute_definition import DbcAttributeDefinition
from cantools.database.can.formats.dbc.dbc_specifics import DbcSpecifics
from cantools.database.conversion import BaseConversion

from gfm_hil.core.roles import OTHER, ROLES, Role
from gfm_runtime.signals import Signal as Row
from gfm_runtime.signals import VectorName, carried_rows, table_hash
from gfm_runtime.states import REASONS, STATES

INT16 = 32767  # largest count; the range is symmetric
INVALID = -32768
SENDERS: dict[VectorName, Role] = {"y": "plant", "u": "controller"}
#: frame name of each vector; if a vector needs several frames, they append _1, _2 …
VECTORS: dict[VectorName, str] = {"y": "Measurements", "u": "Commands"}
#: the same in a run with an inner stage
INNER: dict[VectorName, str] = {name: f"{title}Inner" for name, title in VECTORS.items()}
STATUS: dict[Role, str] = {"plant": "PlantStatus", "controller": "ControllerStatus"}
TRANSPORT: dict[Role, str] = {"plant": "PlantTransport", "controller": "ControllerTransport"}
CRC, COUNTER = "Crc", "Counter"

_HEADER = 2  # bytes of end-to-end protection
_IDS = {"PlantStatus": 0x100, "ControllerStatus": 0x101, "Commands": 0x110, "CommandsInner": 0x118,
        "Measurements": 0x120, "MeasurementsInner": 0x128, "PlantTransport": 0x700,
        "ControllerTransport": 0x701}  # fmt: skip
PAYLOADS = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # bytes of a frame; the index is the DLC
_NODES: dict[Role, str] = {"plant": "Plant", "controller": "Controller"}


def offset(row: Row) -> float:
    """Value of count 0: 0 if the range then fits 16 bits, else the middle of the range. Raises
    ValueError: the range does not fit 16 bits at this scale."""
    if max(abs(row.low), abs(row.high)) <= INT16 * row.scale:
        return 0.0
    if row.high - row.low <= 2 * INT16 * row.scale:
        return (row.low + row.high) / 2
    raise ValueError(f"signal {row.name}: {row.low:g} to {row.high:g} needs more than 16 bits")


def _value(row: Row, start: int) -> Signal:
    conversion = BaseConversion.factory(
        scale=row.scale,
        offset=offset(row),
        choices=OrderedDict({INVALID: "invalid"}),
        is_float=False,
    )
    unit, comment = f"{row.unit} ({row.base})", row.description
    return Signal(
        row.name, 8 * start, 16, is_signed=True, conversion=conversion,
        minimum=row.low, maximum=row.high, unit=unit, comment=comment,
    )  # fmt: skip


def _number(
    name: str, start: int, size: int, comment: str | None, meanings: tuple[str, ...] = ()
) -> Signal:
    conversion = BaseConversion.factory(choices=OrderedDict(enumerate(meanings)) or None)
    return Signal(name, 8 * start, 8 * size, conversion=conversion, comment=comment)


def _protection() -> list[Signal]:
    return [
        _number(CRC, 0, 1, "CRC-8 SAE J1850 over data id and all bytes after this one"),
        _number(COUNTER, 1, 1, "bits 0-5: sequence, 6: lag of the tick, 7: said in the status"),
    ]


def _vector(name: VectorName, inner: int, fd: bool) -> list[tuple[str, int, int, list[Signal]]]:
    """Name, identifier, length and signals of every frame of a vector."""
    rows, vector = carried_rows(name, inner), (INNER if inner else VECTORS)[name]
    room = len(rows) if fd else (8 - _HEADER) // 2
    parts = [rows[k : k + room] for k in range(0, len(rows), room)]
    frames = []
    for k, part in enumerate(parts):
        title = vector + (f"_{k + 1}" if len(parts) > 1 else "")
        values = [_value(row, _HEADER + 2 * j) for j, row in enumerate(part)]
        length = next(n for n in PAYLOADS if n >= _HEADER + 2 * len(part))
        frames.append((title, _IDS[vector] + k, length, [*_protection(), *values]))
    return frames


def _status() -> list[Signal]:
    return [
        *_protection(),
        _number("State", 2, 1, "the controller's; of the plant INIT while it runs", STATES),
        _number("Reason", 3, 1, "why the controller is in that state", REASONS),
        _number("Tick", 4, 4, "of the values that follow"),
    ]


def write_dbc(fd: bool) -> str:
    """The text of the DBC file for CAN FD, or for classic CAN."""
    frames: list[tuple[str, int, int, list[Signal], Role]] = []
    for role in ROLES:
        frames.append((STATUS[role], _IDS[STATUS[role]], 8, _status(), role))
        frames.append((TRANSPORT[role], _IDS[TRANSPORT[role]], 64 if fd else 8, [], role))
    for name, role in SENDERS.items():
        for inner in (False, True):
            frames += [(*frame, role) for frame in _vector(name, inner, fd)]
    messages = []
    for title, number, length, signals, role in sorted(frames, key=lambda f: f[1]):
        for signal in signals:
            signal.receivers = [_NODES[OTHER[role]]]
        messages.append(Message(number, title, length, signals, senders=[_NODES[role]], is_fd=fd))
    database = Database(
        messages,
        nodes=[Node(name) for name in _NODES.values()],
        version=f"gfmhil {table_hash()}",
        dbc_specifics=_bus_type("CAN FD") if fd else None,
    )
    return str(database.as_dbc_string()).replace("\r\n", "\n")


def _bus_type(value: str) -> DbcSpecifics:
    """The attribute without which the file would silently describe classic CAN."""
    definition = DbcAttributeDefinition(
        "BusType", default_value="CAN", kind=None, type_name="STRING"
    )
    definitions: Any = OrderedDict(BusType=definition)
    specifics = DbcSpecifics(attribute_definitions=definitions)
    specifics.attributes["BusType"] = DbcAttribute(value, definition)
    return specifics


def read_dbc(text: str) -> Database:
    """The database as another tool reads it from the file."""
    database = load_string(text, "dbc")
    assert isinstance(database, Database)
    return database
