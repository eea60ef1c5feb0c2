"""What a calibration tool sees as the memory of a live controller: cells of float64, and a text.

| from | what | writable |
|---|---|---|
| 0x800 | a text: what the memory is of, so that a tool can compare its A2L file (EPK) | no |
| 0x1000 | every recorded column of both sides at the newest tick, and its number | no |
| 0x8000 | the references in force | yes |
| 0x9000 | the law in force, index of the laws that are ready | yes |
| 0x10000 | parameters of the first law, every 0x1000 those of the next | if it is in force |

A write becomes a command to the run's command server, whose checks and limits hold therefore.
"""

import hashlib
import json
import math
import struct
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.port import Refusal, refusing
from gfm_hil.recording.columns import ColumnSet, describe
from gfm_hil.scenario.events.reference import check_reference
from gfm_runtime import LawError, law_file
from gfm_runtime.firmware import Entry, a2l_text, unit_of
from gfm_runtime.firmware.c_text import identifier
from gfm_runtime.lawfile import build_law, tied
from gfm_runtime.signals import group, table_hash

#: error codes
OUT_OF_RANGE, WRITE_PROTECTED, ACCESS_DENIED, NOT_NOW = 0x22, 0x23, 0x24, 0x33
CELL = 8  # bytes
_EPK, _MEASURED, _REFERENCES, _LAW, _GAINS = 0x800, 0x1000, 0x8000, 0x9000, 0x10000
_LAW_BYTES = 0x1000  # from the parameters of one law to those of the next
_A_REFERENCE, _THE_LAW = "a reference", "the law"  # no law has such a name
_RECORDED_S = 1.0  # how long a write waits until the recording has it


@dataclass(frozen=True)
class _Number:
    """One number: its description, its value in a snapshot, and the command that writes it."""

    entry: Entry
    value: Callable[[dict[str, Any]], float]
    # of what one command can write: ``_A_REFERENCE``, ``_THE_LAW``, or the law of a gain; empty for
    # what is only measured
    group: str = ""
    key: str = ""  # its name in the command


def _read_column(name: str, now: dict[str, Any]) -> float:
    return float(now[name])


class Memory:
    """The memory of a run.

    Args:
        operator: of the run.
        laws: names of the laws that are ready.
        inner: whether the run has an inner stage, so that it records its columns.
        recorded: how many ticks the controller has recorded.
    """

    def __init__(
        self, operator: Operator, laws: Iterable[str], inner: bool, recorded: Callable[[], int]
    ) -> None:
        self._operator, self._recorded = operator, recorded
        self._laws = list(laws)
        self._files = {name: law_file(name) for name in self._laws}
        self._cells: dict[int, _Number] = {}
        content = json.dumps([inner, *(f.model_dump_json() for f in self._files.values())])
        digest = hashlib.sha256(f"{table_hash()}{content}".encode()).hexdigest()[:32]
        #: what the memory is of: which gfmhil, and a digest of the laws and of the signals
        self.epk = f"gfmhil {version('gfmhil')}; {digest}"
        columns = ColumnSet(inner)
        names = ["tick", *columns.signals("plant"), *columns.signals("controller")]
        for k, name in enumerate(names):
            self._add(self._measurement(name, _MEASURED + k * CELL))
        for k, s in enumerate(group("ref")):
            entry = Entry(
                s.name, f"reference: {s.description}", "FLOAT64_IEEE", _REFERENCES + k * CELL,
                unit_of(s), s.low, s.high, calibrated=True,
            )  # fmt: skip
            self._add(_Number(entry, partial(_read_column, f"ref_{s.name}"), _A_REFERENCE, s.name))
        words = tuple(enumerate(self._laws))
        entry = Entry(
            "active_law", "the law in force", "FLOAT64_IEEE", _LAW, low=0.0, words=words,
            high=len(words) - 1.0, calibrated=True,
        )  # fmt: skip
        self._add(_Number(entry, lambda now: self._laws.index(now["active"]), _THE_LAW))
        for k, (law, file) in enumerate(self._files.items()):
            if len(file.parameters) * CELL > _LAW_BYTES:
                raise UserError(f"law {law}: has more than {_LAW_BYTES // CELL} parameters")
            for j, (name, spec) in enumerate(file.parameters.items()):
                entry = Entry(
                    f"{identifier(law)}.{name}",
                    ": ".join(filter(None, (f"gain of {law}", spec.source))), "FLOAT64_IEEE",
                    _GAINS + k * _LAW_BYTES + j * CELL, spec.unit, calibrated=True,
                    fixed=file.schedule is not None,
                )  # fmt: skip
                self._add(_Number(entry, partial(self._gain, law, name), law, name))

    def _add(self, cell: _Number) -> None:
        self._cells[cell.entry.address] = cell

    def _measurement(self, name: str, address: int) -> _Number:
        row = describe(name, self._laws)
        low, high = row.limits or (None, None)
        entry = Entry(
            name, row.comment, "FLOAT64_IEEE", address, row.unit, low, high, words=row.words
        )
        if name == "law":  # of the recording: one more for each change of gains
            entry = replace(entry, text="number of the law with its gains, as recorded", words=())
        if name == "state":  # a snapshot has its word
            numbers = {word: number for number, word in row.words}
            return _Number(entry, lambda now: numbers[now[name]])
        return _Number(entry, partial(_read_column, name))

    def _gain(self, law: str, name: str, now: dict[str, Any]) -> float:
        file = self._files[law]
        changed = tied(file, now["gains"]) if law == now["active"] else {}
        return float(changed.get(name, file.parameters[name].value))

    def a2l(self, name: str, more: Iterable[str] = ()) -> str:
        """The A2L text of this memory; ``more``: lines of its module."""
        entries = [cell.entry for cell in self._cells.values()]
        return a2l_text(
            name, "a controller on the bench of gfmhil", entries, False, more, [(_EPK, self.epk)]
        )

    def read(self, address: int, size: int) -> bytes:
        """Bytes of the memory, all of the same tick. Raises Refusal: there is no such memory, or
        the run has not begun."""
        if address >= _EPK and address + size <= _EPK + len(self.epk):
            return self.epk.encode()[address - _EPK :][:size]
        first = address - address % CELL
        cells = [self._at(at) for at in range(first, address + size, CELL)]
        now = self._now()
        try:
            whole = b"".join(struct.pack("<d", cell.value(now)) for cell in cells)
        except (KeyError, ValueError):
            raise Refusal(NOT_NOW, "the run has not recorded it yet") from None
        return whole[address - first : address - first + size]

    def write(self, address: int, data: bytes, by: Any) -> None:
        """Write whole cells by one command to the run; it holds from one tick on. Raises Refusal:
        no whole cells, what cannot be written, a wrong value, or the run refuses it.

        Args:
            address: of the first cell.
            data: of whole cells of one kind.
            by: who writes, see ``Operator.command``.
        """
        if not data or address % CELL or len(data) % CELL:
            raise Refusal(OUT_OF_RANGE, f"{address:#x}: numbers of {CELL} bytes are written whole")
        cells = [self._at(address + k) for k in range(0, len(data), CELL)]
        kind = cells[0].group
        if any(not cell.group or cell.entry.fixed for cell in cells):
            raise Refusal(WRITE_PROTECTED, f"{address:#x}: can only be read")
        if any(cell.group != kind for cell in cells):
            raise Refusal(OUT_OF_RANGE, f"{address:#x}: the numbers are of two commands")
        numbers = struct.unpack(f"<{len(cells)}d", data)
        given = {cell.key: value for cell, value in zip(cells, numbers, strict=True)}
        event = self._event(kind, given)
        if event is None:
            return
        with refusing(ACCESS_DENIED, UserError):
            tick = self._operator.command(event, by)["tick"]
        until = time.monotonic() + _RECORDED_S
        while self._recorded() <= tick and time.monotonic() < until:
            time.sleep(1e-3)  # tools read back what they have written

    def _event(self, kind: str, given: dict[str, float]) -> dict[str, Any] | None:
        """The command of a write, or None if it changes nothing."""
        with refusing(OUT_OF_RANGE, ValueError):
            if not all(map(math.isfinite, given.values())):
                raise ValueError(f"{given}: must be finite")
            if kind == _A_REFERENCE:
                for name, value in given.items():
                    check_reference(name, value)
                return {"type": "reference", **given}
            if kind == _THE_LAW:
                (number,) = given.values()
                if number not in range(len(self._laws)):
                    raise ValueError(f"law {number:g}: must be one of 0 to {len(self._laws) - 1}")
                return {"type": "law", "law": self._laws[int(number)]}
        now = self._now()
        if now.get("active") != kind:
            raise Refusal(ACCESS_DENIED, f"{kind}: is not the law in force")
        values = {n: v for n, v in given.items() if v != self._gain(kind, n, now)}
        with refusing(OUT_OF_RANGE, LawError):
            build_law(self._files[kind], tied(self._files[kind], {**now["gains"], **values}))
        return {"type": "gains", "values": values} if values else None

    def _at(self, address: int) -> _Number:
        cell = self._cells.get(address)
        if cell is None:
            raise Refusal(OUT_OF_RANGE, f"{address:#x}: there is no such memory")
        return cell

    def _now(self) -> dict[str, Any]:
        with refusing(NOT_NOW, UserError):
            return self._operator.snapshot()
