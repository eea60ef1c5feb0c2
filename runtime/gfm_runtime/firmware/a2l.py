"""A calibration file: ASAP2 1.71 text (A2L) of what a tool measures and calibrates in a memory.

ASAM MCD-2 MC 1.7.1 defines the format. The entries come from the ELF file of a firmware
(``gfm_runtime.firmware.elf``), or from the memory of an XCP slave.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import identifier, plain
from gfm_runtime.signals import Signal

#: by ASAP2's name of a type: its bytes, and the least and most of its values
TYPES = {
    "UBYTE": (1, 0.0, 255.0),
    "SBYTE": (1, -128.0, 127.0),
    "UWORD": (2, 0.0, 65535.0),
    "SWORD": (2, -32768.0, 32767.0),
    "ULONG": (4, 0.0, 2.0**32 - 1),
    "SLONG": (4, -(2.0**31), 2.0**31 - 1),
    "A_UINT64": (8, 0.0, 2.0**64),
    "A_INT64": (8, -(2.0**63), 2.0**63),
    "FLOAT32_IEEE": (4, -3.4028234663852886e38, 3.4028234663852886e38),
    "FLOAT64_IEEE": (8, -1.7976931348623157e308, 1.7976931348623157e308),
}
_LAST_ADDRESS = 2**32 - 1


@dataclass(frozen=True)
class Entry:
    """One number, or one array of numbers, in a memory."""

    name: str  #: of the entry, unique; parts of a struct are joined by dots
    text: str  #: what it is, one line
    kind: str  #: a key of ``TYPES``
    address: int  #: of its first byte
    unit: str = ""  #: with its base, e.g. ``p.u. (S_n)``; empty for a number without one.
    #: low, high: plausible range; the whole range of its type if None
    low: float | None = None
    high: float | None = None
    shape: tuple[int, ...] = ()  #: of an array in C's order; empty for a number
    words: tuple[tuple[int, str], ...] = ()  #: meanings of the values of a code
    symbol: str = ""  #: how C names it, e.g. ``law.u[0]``; empty if no program has it.
    calibrated: bool = False  #: whether a tool may write it (a CHARACTERISTIC), or only measure it
    fixed: bool = False  #: of what is calibrated: lies in memory that cannot be written


def unit_of(signal: Signal) -> str:
    """The unit of a signal with its base, e.g. ``p.u. (S_n)``."""
    return f"{signal.unit} ({signal.base})"


def a2l_text(
    project: str,
    about: str,
    entries: Sequence[Entry],
    big_endian: bool = False,
    more: Iterable[str] = (),
    identifications: Sequence[tuple[int, str]] = (),
) -> str:
    """The text of an A2L file. Raises LawError: two entries of one name, or an address of more than
    32 bits.

    Args:
        project: what its name ends in, and that of its only module.
        about: one line about it.
        entries: in their order.
        big_endian: byte order of the memory.
        more: lines of the module, such as an IF_DATA block.
        identifications: texts in the memory by which a tool knows that the file is of this program,
            with their addresses. The first one becomes the EPK, of which there can be one only.
    """
    methods: dict[str, list[str]] = {}
    kinds: set[str] = set()
    blocks: list[str] = []
    names: set[str] = set()
    for entry in entries:
        if entry.name in names:
            raise LawError(entry.name, "two variables have this name")
        if not 0 <= entry.address <= _LAST_ADDRESS:
            raise LawError(entry.name, f"address {entry.address:#x} must have at most 32 bits")
        names.add(entry.name)
        blocks += _block(entry, _method(entry, methods))
        kinds |= {entry.kind} if entry.calibrated else set()
    name = f"gfmhil_{identifier(project)}"
    order = "MSB_FIRST" if big_endian else "MSB_LAST"
    module = ['/begin MOD_COMMON ""', f"  BYTE_ORDER {order}", "/end MOD_COMMON"]
    for address, text in identifications[:1]:
        every = " | ".join(text for _, text in identifications)
        module += ['/begin MOD_PAR ""', f"  VERSION {_quote(every)}"]
        module += [f"  ADDR_EPK {address:#x}", f"  EPK {_quote(text)}", "/end MOD_PAR"]
    module += more
    module += [line for lines in methods.values() for line in lines]
    for kind in sorted(kinds):
        module += [f"/begin RECORD_LAYOUT {kind}_rows", f"  FNC_VALUES 1 {kind} ROW_DIR DIRECT",
                   "/end RECORD_LAYOUT"]  # fmt: skip
    head = f"{name} {_quote(about)}"
    return (
        f"ASAP2_VERSION 1 71\n/begin PROJECT {head}\n  /begin MODULE {head}\n"
        + "".join(f"    {line}\n" for line in (*module, *blocks))
        + "  /end MODULE\n/end PROJECT\n"
    )


def _quote(text: str) -> str:
    escaped = plain(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def _number(value: float) -> str:
    return repr(int(value)) if value == math.floor(value) and abs(value) < 1e15 else repr(value)


def _method(entry: Entry, methods: dict[str, list[str]]) -> str:
    """The name of the entry's COMPU_METHOD, which is added to ``methods`` once."""
    if not (entry.words or entry.unit):
        return "NO_COMPU_METHOD"
    own = entry.name.rpartition(".")[2]
    first = f"{identifier(own)}_code" if entry.words else f"in_{identifier(entry.unit)}"
    for k in range(len(methods) + 1):  # two units may be the same as an identifier
        name = f"{first}_{k}" if k else first
        if entry.words:
            lines = [
                f'/begin COMPU_METHOD {name} "" TAB_VERB "%3.0" ""',
                f"  COMPU_TAB_REF {name}_words",
                "/end COMPU_METHOD",
                f'/begin COMPU_VTAB {name}_words "" TAB_VERB {len(entry.words)}',
                *(f"  {code} {_quote(word or 'none')}" for code, word in entry.words),
                "/end COMPU_VTAB",
            ]
        else:
            text = f'"" IDENTICAL "%12.6" {_quote(entry.unit)}'
            lines = [f"/begin COMPU_METHOD {name} {text}", "/end COMPU_METHOD"]
        if methods.setdefault(name, lines) == lines:
            return name
    raise AssertionError(first)


def _block(entry: Entry, method: str) -> list[str]:
    """The MEASUREMENT or the CHARACTERISTIC of an entry."""
    _, least, most = TYPES[entry.kind]
    low = least if entry.low is None else max(entry.low, least)
    high = most if entry.high is None else min(entry.high, most)
    ends, what = f"{_number(low)} {_number(high)}", "MEASUREMENT"
    lines = [f"  {entry.kind} {method} 0 0 {ends}", f"  ECU_ADDRESS {entry.address:#x}"]
    if entry.calibrated:
        what, kind = "CHARACTERISTIC", "VAL_BLK" if entry.shape else "VALUE"
        lines = [f"  {kind} {entry.address:#x} {entry.kind}_rows 0 {method} {ends}"]
    lines += [f"  MATRIX_DIM {' '.join(map(str, entry.shape))}"] if entry.shape else []
    lines += [f'  SYMBOL_LINK "{entry.symbol}" 0'] if entry.symbol else []
    lines += ["  READ_ONLY"] if entry.calibrated and entry.fixed else []
    return [f"/begin {what} {entry.name} {_quote(entry.text)}", *lines, f"/end {what}"]
