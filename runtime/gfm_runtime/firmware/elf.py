"""What a calibration tool can see of our laws in the ELF file of a firmware, from its DWARF.

Looks for variables, also of C's file scope and inside of structs, of the types that
``gfm_runtime.firmware.module`` writes: instances of a law (``gfm_..._t``), its record
(``gfm_law_t``, style ``records``), its identification (``gfm_..._id``), and vectors named ``y``,
``u`` or ``ref`` of the law's numbers (``gfm_..._real``). Needs pyelftools.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gfm_runtime.errors import LawError
from gfm_runtime.firmware.a2l import Entry, a2l_text, unit_of
from gfm_runtime.firmware.module import RESULTS
from gfm_runtime.firmware.tick import SHARED
from gfm_runtime.inner import INNER_CONSTANTS, INNER_STATE
from gfm_runtime.regular import open_regular
from gfm_runtime.signals import Signal, carried_rows, command_rows, group

_INSTANCE = re.compile(r"gfm(_\w+)?_t")
_IDENTIFICATION = re.compile(r"gfm_\w+_id")
_RECORD = "gfm_law_t"
_REAL = re.compile(r"gfm(_\w+)?_real")
_MOST_ELEMENTS = 64  # of an array of instances
_MOST_BYTES = 1 << 28
_MOST_LINKS = 64  # from a variable to its type: more of them go in a circle
_DECLARATIONS = ("DW_AT_specification", "DW_AT_abstract_origin")
_FLOATS = {4: "FLOAT32_IEEE", 8: "FLOAT64_IEEE"}
_SIGNED = {1: "SBYTE", 2: "SWORD", 4: "SLONG", 8: "A_INT64"}
_UNSIGNED = {1: "UBYTE", 2: "UWORD", 4: "ULONG", 8: "A_UINT64"}
_CODES = tuple((code, text) for code, text in RESULTS.values())

#: members of an instance that have one element for each row of u, with what they are
_BY_ROW = {
    "offset": "what a change of law left in {}",
    "u": "the law's last {}",
    "trend": "filtered change of {} per tick",
    "u_0": "set-point of {}",
    "low": "lower limit of {}",
    "high": "upper limit of {}",
}
#: other members of an instance
_PLAIN = {
    "x": "states of the law, scaled",
    "reason": "why it is in the safe state",
    "channel": "index of the signal that was the reason, or -1",
    "limited": "whether the inner stage limits the current",
    "X": "estimated reactance of the grid",
    "active": "stage of the schedule that is in force",
    **{name: remark for name, _, remark in INNER_STATE if remark},
}
#: members of a law's record
_OF_RECORD = {
    "n": "states in use",
    "error_map": "code of the error map",
    "error_parameters": "R and X of the line, p.u., of the error map hybrid-angle",
    "A": "states to states",
    "B_r": "references to states",
    "B_y": "measurements to states",
    "C": "states to u",
    "D_r": "references to u",
    "D_y": "measurements to u",
    "D_u0": "set-points of u that follow a reference",
    "loop": "1/(1 - D_y[1][2]); change it together with D_y",
    "W": "anti-windup",
    "decay": "of the offset, per tick",
    "follow": "of the trend filter, per tick",
    **dict.fromkeys(("E_r", "E_y", "F", "G"), "of the bumpless change"),
    **{name: "of the inner stage" for name in INNER_CONSTANTS if name not in SHARED},
}


@dataclass(frozen=True)
class _Place:
    """Where in a program: the name of the entry, C's name, the address, and whether it is const."""

    name: str
    symbol: str
    address: int
    fixed: bool = False

    def member(self, name: str, offset: int) -> _Place:
        at = self.address + offset
        return _Place(f"{self.name}.{name}", f"{self.symbol}.{name}", at, self.fixed)

    def element(self, k: int, size: int, name: str = "") -> _Place:
        own = f"{self.name}.{name}" if name else f"{self.name}[{k}]"
        return _Place(own, f"{self.symbol}[{k}]", self.address + k * size, self.fixed)


@dataclass(frozen=True)
class _Type:
    """A type without its qualifiers: its DIE, the names it was given, and the shape of an array."""

    die: Any
    names: tuple[str, ...]
    fixed: bool = False
    shape: tuple[int, ...] = ()

    def named(self, pattern: re.Pattern[str]) -> bool:
        return any(pattern.fullmatch(name) for name in self.names)

    @property
    def size(self) -> int:
        """Bytes of one element."""
        return int(self.die.attributes["DW_AT_byte_size"].value)


def elf_a2l(path: Path) -> tuple[str, int, int]:
    """The A2L text of a firmware; how many measurements and characteristics it has. Raises
    LawError: it is no linked ELF file, has no debug information, or no exported law. Raises
    OSError: it cannot be opened, is no regular file or is too large."""
    entries, big_endian, identifications = elf_entries(path)
    about = f"laws of gfmhil in {path.name}"
    calibrated = sum(entry.calibrated for entry in entries)
    text = a2l_text(path.stem, about, entries, big_endian, (), identifications)
    return text, len(entries) - calibrated, calibrated


def elf_entries(path: Path) -> tuple[list[Entry], bool, list[tuple[int, str]]]:
    """What can be measured and calibrated, by address; whether the program is big-endian; and the
    addresses and texts of the laws' identifications. Raises LawError, OSError: as ``elf_a2l``."""
    from elftools.common.exceptions import ELFError
    from elftools.elf.elffile import ELFFile

    where = str(path)
    file = open_regular(path, _MOST_BYTES)
    try:
        with file:
            elf = ELFFile(file)
            if elf["e_type"] == "ET_REL":
                raise LawError(where, "is not linked, so that it has no addresses")
            if not elf.has_dwarf_info(strict=True):
                raise LawError(where, "has no debug information; compile and link with -g")
            found: dict[str, Entry] = {}
            identifications = dict[int, str]()
            for place, kind in _variables(elf.get_dwarf_info()):
                for entry in _entries(place, kind):
                    found.setdefault(entry.name, entry)
                if _IDENTIFICATION.fullmatch(place.symbol) and len(kind.shape) == 1:
                    data = _bytes(elf, place.address, kind.shape[0])
                    identifications[place.address] = data.rstrip(b"\0").decode("ascii")
            big_endian = not elf.little_endian
    except LawError:
        raise
    except ELFError as problem:
        raise LawError(where, f"is no readable ELF file: {problem}") from None
    except Exception as problem:  # pyelftools raises anything for what is damaged
        raise LawError(where, f"is damaged: {problem!r}") from None
    if not found:
        why = "has no variable of an exported law (gfm_..._t, gfm_law_t); compile its file with -g"
        raise LawError(where, why)
    entries = sorted(found.values(), key=lambda entry: entry.address)
    return entries, big_endian, sorted(identifications.items())


def _bytes(elf: Any, address: int, size: int) -> bytes:
    """What the program has in its memory when it starts; none if that is not in the file."""
    for segment in elf.iter_segments("PT_LOAD"):
        at = address - segment["p_vaddr"]
        if at >= 0 and at + size <= segment["p_filesz"]:
            return bytes(segment.data()[at : at + size])
    return b""


def _variables(dwarf: Any) -> Iterator[tuple[_Place, _Type]]:
    """Every variable with a fixed address."""
    for unit in dwarf.iter_CUs():
        for die in unit.iter_DIEs():
            if die.tag != "DW_TAG_variable" or "DW_AT_location" not in die.attributes:
                continue
            address = _address(dwarf, unit, die.attributes["DW_AT_location"])
            said = die  # the DIE that has the name: itself, or that of its declaration
            for _ in range(_MOST_LINKS):
                links = [a for a in _DECLARATIONS if a in said.attributes]
                if "DW_AT_name" in said.attributes or not links:
                    break
                said = said.get_DIE_from_attribute(links[0])
            if address is None or "DW_AT_name" not in said.attributes:
                continue
            name, kind = _name(said), _type(said)
            if kind is not None:
                yield _Place(name, name, address, kind.fixed), kind


def _address(dwarf: Any, unit: Any, location: Any) -> int | None:
    """The address that a location of DW_OP_addr or DW_OP_addrx gives, or None for another one."""
    from elftools.dwarf.dwarf_expr import DWARFExprParser

    if not location.form.startswith(("DW_FORM_exprloc", "DW_FORM_block")):
        return None  # a list of places
    match DWARFExprParser(unit.structs).parse_expr(location.value):
        case [step] if step.op_name == "DW_OP_addr":
            return int(step.args[0])
        case [step] if step.op_name == "DW_OP_addrx":
            return int(dwarf.get_addr(unit, step.args[0]))
    return None


def _name(die: Any) -> str:
    return str(die.attributes["DW_AT_name"].value.decode("utf-8", "replace"))


def _type(die: Any) -> _Type | None:
    """The type of a variable, member or array, or None for one without (void)."""
    names: list[str] = []
    fixed, shape = False, tuple[int, ...]()
    for _ in range(_MOST_LINKS):
        if "DW_AT_type" not in die.attributes:
            break
        die = die.get_DIE_from_attribute("DW_AT_type")
        if die.tag == "DW_TAG_typedef":
            names.append(_name(die))
        elif die.tag == "DW_TAG_const_type":
            fixed = True
        elif die.tag == "DW_TAG_array_type":
            shape += tuple(_count(d) for d in die.iter_children() if "subrange" in d.tag)
        elif die.tag != "DW_TAG_volatile_type":
            return _Type(die, tuple(names), fixed, shape)
    return None


def _count(dimension: Any) -> int:
    given = dimension.attributes
    if "DW_AT_count" in given:
        return int(given["DW_AT_count"].value)
    return int(given["DW_AT_upper_bound"].value) + 1 if "DW_AT_upper_bound" in given else 0


def _members(kind: _Type) -> Iterator[tuple[str, int, _Type]]:
    for die in kind.die.iter_children():
        of = _type(die) if die.tag == "DW_TAG_member" and "DW_AT_name" in die.attributes else None
        if of is not None:
            offset = die.attributes.get("DW_AT_data_member_location")
            yield _name(die), int(offset.value) if offset else 0, of


def _entries(place: _Place, kind: _Type, law: str = "") -> Iterator[Entry]:
    """The entries of a variable, or of a part of one; ``law``: inside of an instance or record."""
    if kind.die.tag == "DW_TAG_structure_type":
        if kind.shape:
            count = min(kind.shape[0], _MOST_ELEMENTS) if len(kind.shape) == 1 else 0
            for k in range(count):
                yield from _entries(place.element(k, kind.size), replace(kind, shape=()), law)
            return
        if _RECORD in kind.names:
            law = "record"
        elif kind.named(_INSTANCE):
            law = "instance"
        for name, offset, of in _members(kind):
            inside = replace(place.member(name, offset), fixed=place.fixed or of.fixed)
            yield from _entries(inside, of, law)
    elif kind.die.tag == "DW_TAG_base_type":
        if law:
            yield from _numbers(place, kind, law)
        elif kind.named(_REAL):
            rows = _vector(place, kind)
            yield from _by_signal(place, kind, rows, {"": "{}"}, "") if rows else ()


def _vector(place: _Place, kind: _Type) -> tuple[Signal, ...]:
    """The signals of a vector y, u or ref by its name and its length; none if it is no such."""
    own = re.split(r"[._]", re.sub(r"\[\d+\]", "", place.name))[-1]
    vectors = [("ref", group("ref"))]
    for inner in (False, True):
        vectors += [("y", carried_rows("y", inner)), ("u", command_rows(inner))]
    fits = (rows for name, rows in vectors if name == own and kind.shape == (len(rows),))
    return next(fits, ())


def _numbers(place: _Place, kind: _Type, law: str) -> Iterator[Entry]:
    """The entries of a member of an instance or of a record."""
    own = place.name.rpartition(".")[2]
    if own in _BY_ROW and kind.shape == (len(group("u")),):
        yield from _by_signal(place, kind, group("u"), _BY_ROW, own, law == "record")
        return
    text = (_OF_RECORD if law == "record" else _PLAIN).get(own, "")
    words = _CODES if own == "reason" else ()
    whole_number = not _kind(kind).startswith("FLOAT")
    yield Entry(
        place.name, text, _kind(kind), place.address, "p.u. (Z_b)" if own == "X" else "",
        shape=kind.shape, words=words, symbol=place.symbol, calibrated=law == "record",
        fixed=place.fixed or whole_number,  # another order or error map is another law
    )  # fmt: skip


def _by_signal(
    place: _Place,
    kind: _Type,
    rows: tuple[Signal, ...],
    texts: dict[str, str],
    own: str,
    calibrated: bool = False,
) -> Iterator[Entry]:
    """An entry for each element of a vector that has one for each signal."""
    within = own not in ("offset", "trend")  # these are differences
    for k, s in enumerate(rows):
        at = place.element(k, kind.size, s.name)
        yield Entry(
            at.name, texts[own].format(f"{s.name}: {s.description}" if within else s.name),
            _kind(kind), at.address, unit_of(s),
            s.low if within else s.low - s.high, s.high if within else s.high - s.low,
            symbol=at.symbol, calibrated=calibrated, fixed=place.fixed,
        )  # fmt: skip


def _kind(kind: _Type) -> str:
    """ASAP2's name of a base type. Raises KeyError: it has none, as a long double."""
    encoding = kind.die.attributes["DW_AT_encoding"].value
    by_size = {4: _FLOATS, 5: _SIGNED, 6: _SIGNED}.get(encoding, _UNSIGNED)  # DW_ATE_float, signed
    return by_size[kind.size]
