"""Power-flow cases of PSS/E (.raw, revisions 30 to 35) as nets of pandapower.

A file is three lines of title, and then sections of records, one a line (a transformer takes four
or five), whose fields are divided by commas. A line that begins with 0 ends a section, one that
begins with @! is a comment. Buses keep the voltages at which the file's own power flow holds them.
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from gfm_hil.api.case_tables import CaseTables, Winding
from gfm_hil.api.dyr import number
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import lines_of

_SECTIONS = (
    "bus", "load", "fixed shunt", "generator", "branch", "transformer", "area",
    "two-terminal DC line", "VSC DC line", "impedance correction", "multi-terminal DC line",
    "multi-section line", "zone", "transfer", "owner", "FACTS device", "switched shunt",
    "GNE device", "induction machine",
)  # fmt: skip
_SWITCHES = "system switching device"
_NEWER = ("system-wide data", *_SECTIONS[:5], _SWITCHES, *_SECTIONS[5:], "substation")
#: of revisions 30, 34 and 35; the others have those above
_OTHER_SECTIONS = {
    30: (
        "bus", "load", "generator", "branch", "transformer", "area", "two-terminal DC line",
        "VSC DC line", "switched shunt", "impedance correction", "multi-terminal DC line",
        "multi-section line", "zone", "transfer", "owner", "FACTS device",
    ),
    34: _NEWER,
    35: _NEWER,
}  # fmt: skip
#: those that a network has not, and the lines that a record of them takes
_LEFT_OUT = {
    "two-terminal DC line": 3,
    "VSC DC line": 3,
    "multi-terminal DC line": 1,
    "FACTS device": 1,
    "induction machine": 1,
}
#: where the fields of a record are that are read here; those of a transformer by its line
_FIELDS = {
    "bus": {"I": 0, "IDE": 3, "VM": 7, "VA": 8},
    "load": {"I": 0, "STATUS": 2, "PL": 5, "QL": 6, "IP": 7, "IQ": 8, "YP": 9, "YQ": 10},
    "fixed shunt": {"I": 0, "STATUS": 2, "GL": 3, "BL": 4},
    "switched shunt": {"I": 0, "STATUS": 3, "BL": 9},
    "generator": {"I": 0, "PG": 2, "MBASE": 8, "ZX": 10, "STATUS": 14},
    "branch": {"I": 0, "J": 1, "R": 3, "X": 4, "B": 5, "GI": 9, "BI": 10, "GJ": 11, "BJ": 12,
               "STATUS": 13},
    _SWITCHES: {"I": 0, "J": 1, "STATUS": 16},
    "transformer": {"I": 0, "J": 1, "K": 2, "CW": 4, "CZ": 5, "CM": 6, "MAG1": 7, "MAG2": 8,
                    "STATUS": 11},
}  # fmt: skip
_NEWER_BRANCH = {"I": 0, "J": 1, "R": 3, "X": 4, "B": 5, "GI": 19, "BI": 20, "GJ": 21, "BJ": 22,
                 "STATUS": 23}  # fmt: skip
#: where these revisions have them otherwise; a bus of revision 30 has its shunt with it
_OTHER_FIELDS: dict[int, dict[str, dict[str, int]]] = {
    30: {
        "bus": {"I": 0, "IDE": 3, "GL": 4, "BL": 5, "VM": 8, "VA": 9},
        "switched shunt": {"I": 0, "BL": 7},
    },
    34: {"branch": _NEWER_BRANCH},
    35: {
        "branch": _NEWER_BRANCH,
        "generator": {"I": 0, "PG": 2, "MBASE": 9, "ZX": 11, "STATUS": 15},
        "switched shunt": {"I": 0, "STATUS": 4, "BL": 11},
    },
}
_ELSE = {"STATUS": 1.0, "CW": 1.0, "CZ": 1.0, "CM": 1.0, "IDE": 1.0, "VM": 1.0, "ZX": 1.0}
_JUMPER = 1e-4  # p.u.; a branch of less is none to PSS/E (THRSHZ), and makes two buses one


class _Record(NamedTuple):
    where: str  # file, line and kind
    fields: list[str]

    def number(self, name: str, at: int, otherwise: float = 0.0) -> float:
        text = self.fields[at] if at < len(self.fields) else ""
        return number(f"{self.where}, {name}", text) if text else otherwise

    def positive(self, name: str, at: int, otherwise: float) -> float:
        value = self.number(name, at) or otherwise
        if value < 0.0:
            raise UserError(f"{self.where}, {name}: {value:g}: must be above 0")
        return value

    def numbers(self, places: Mapping[str, int]) -> dict[str, float]:
        """Its fields by name; those that it leaves out have PSS/E's values."""
        return {name: self.number(name, at, _ELSE.get(name, 0.0)) for name, at in places.items()}


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """The number of each line that is no comment, and its fields, without its comment."""
    for k, line in enumerate(lines_of(path), 1):
        if line.startswith("@!"):
            continue
        fields = []
        for one, end in re.findall(r"\s*('[^']*'|[^,/']*)\s*(,|/|$)", line):
            fields.append(one.strip("' "))
            if end != ",":
                break
        yield k, fields


class RawCase(CaseTables):
    """A case of PSS/E.

    Raises:
        UserError: the file cannot be read, is of another revision, or a record is none; the message
            has the file, the line and the field.
    """

    def __init__(self, path: Path) -> None:
        lines = list(_lines(path))
        line, fields = lines[0] if lines else (1, list[str]())
        head = _Record(f"{path}, line {line}", fields)
        revision = head.number("REV", 2)
        if revision not in range(30, 36):
            raise UserError(f"{head.where}, REV: revision {revision:g}: must be from 30 to 35")
        self.places = _FIELDS | _OTHER_FIELDS.get(int(revision), {})
        self.names = _OTHER_SECTIONS.get(int(revision), _SECTIONS)
        super().__init__(head.positive("SBASE", 1, 100.0), head.positive("BASFRQ", 5, 60.0))
        self.path = path
        self.sections = self._divided(lines[3:])
        self.numbers: set[float] = set()  # of all buses, isolated ones too
        self._fill()

    def _divided(self, lines: list[tuple[int, list[str]]]) -> dict[str, list[_Record]]:
        sections = {name: list[_Record]() for name in _NEWER}
        names = iter(self.names)
        name = next(names)
        for k, fields in lines:
            if fields[0] in ("0", "Q") and len(fields) == 1:
                if fields[0] == "Q" or (name := next(names, "")) == "":
                    break
            else:
                sections[name].append(_Record(f"{self.path}, line {k}, {name}", fields))
        return sections

    def _fill(self) -> None:
        for record in self.sections["bus"]:
            p = record.numbers(self.places["bus"])
            self.numbers.add(p["I"])
            if p["IDE"] != 4.0:  # isolated
                kV = record.positive("BASKV", 2, 1.0)
                Y = p.get("GL", 0.0), p.get("BL", 0.0)
                values = [1.0, 0.0, 0.0, *Y, p["VM"], p["VA"], kV]
                self.buses[int(p["I"])] = values
                if p["IDE"] == 3.0:
                    values[0] = 3.0
        self._loads()
        self._shunts()
        self._generators()
        self._lines()
        self._transformers()
        self.join_series_capacitors()
        for kind, each in _LEFT_OUT.items():
            if count := len(self.sections[kind]) // each:
                self.ignored.append(f"{count} {kind}{'s' * (count > 1)}: left out.")

    def _working(self, kind: str) -> Iterator[tuple[_Record, dict[str, float]]]:
        """The records of a kind that are in service, as is their bus."""
        for record in self.sections[kind]:
            p = record.numbers(self.places[kind])
            if p.get("STATUS", 1.0) and all(
                self._has(record, n, p) for n in "IJK" if n in p and (p[n] or n != "K")
            ):
                yield record, p

    def _has(self, record: _Record, name: str, p: dict[str, float]) -> bool:
        """Whether a bus is in service."""
        p[name] = abs(p[name])  # the sign says where a flow is metered
        if p[name] not in self.numbers:
            raise UserError(f"{record.where}, {name}: {p[name]:g}: there is no such bus")
        return p[name] in self.buses

    def _loads(self) -> None:
        for _, p in self._working("load"):
            bus = self.buses[int(p["I"])]
            V = bus[5]
            bus[1] += p["PL"] + p["IP"] * V + p["YP"] * V**2
            bus[2] += p["QL"] + p["IQ"] * V - p["YQ"] * V**2

    def _shunts(self) -> None:
        for kind in ("fixed shunt", "switched shunt"):
            for _, p in self._working(kind):
                self.shunt(int(p["I"]), complex(p.get("GL", 0.0), p["BL"]))

    def _generators(self) -> None:
        """P, MBASE, and MBASE by ZSOURCE of all generators of each bus, which holds its voltage."""
        for _, p in self._working("generator"):
            k, S = int(p["I"]), p["MBASE"] or self.S_b
            before = self.generators.get(k, (0.0, 0.0, 0.0))
            by_X = S / p["ZX"] if p["ZX"] else math.inf
            self.generators[k] = (before[0] + p["PG"], before[1] + S, before[2] + by_X)
            self.buses[k][0] = max(self.buses[k][0], 2.0)

    def _lines(self) -> None:
        self.jumpers += [(int(p["I"]), int(p["J"])) for _, p in self._working(_SWITCHES)]
        for _, p in self._working("branch"):
            a, b = int(p["I"]), int(p["J"])
            if abs(complex(p["R"], p["X"])) < _JUMPER:
                self.jumpers.append((a, b))
                continue
            for k, end in ((a, "I"), (b, "J")):
                if p[f"G{end}"] < 0.0:
                    self.ignored.append(f"G{end} = {p[f'G{end}']:g} of line {a}-{b} is left out.")
                self.shunt(k, complex(max(p[f"G{end}"], 0.0), p[f"B{end}"]) * self.S_b)
            self.branches.append([a, b, p["R"], p["X"], p["B"], 0.0, 0.0])

    def _transformers(self) -> None:
        own, records = self.sections["transformer"], dict[int, list[_Record]]()
        k = 0
        while k < len(own):  # the third field is the third bus, 0 for two windings
            length = 4 if own[k].number("K", 2) == 0.0 else 5
            records[k], k = own[k : k + length], k + length
        self.sections["transformer"] = [lines[0] for lines in records.values()]
        lines_of = {lines[0].where: lines for lines in records.values()}
        for record, p in self._working("transformer"):
            lines = lines_of[record.where]
            if len(lines) < (5 if p["K"] else 4):
                raise UserError(f"{record.where}: the record does not end")
            pairs = [self._impedance(lines[1], p, 3 * j) for j in range(3 if p["K"] else 1)]
            windings = [
                self._winding(line, int(p[name]), p["CW"])
                for line, name in zip(lines[2:], "IJK", strict=False)
            ]
            G, B = p["MAG1"], p["MAG2"]
            if p["CM"] == 2.0:  # W, and a current in p.u.
                S = lines[1].positive("SBASE1-2", 2, self.S_b)
                G, B = G / 1e6 / self.S_b, -math.sqrt(max((B * S / self.S_b) ** 2 - G**2, 0.0))
            self.shunt(windings[0].bus, complex(G, B) * self.S_b)
            if not p["K"]:
                self.leg(windings[0], windings[1], pairs[0])
                continue
            Z12, Z23, Z31 = pairs
            star = max(self.buses) + 1
            kV = min(self.buses[w.bus][7] for w in windings)
            V, angle = (lines[1].number(n, at) for n, at in (("VMSTAR", 9), ("ANSTAR", 10)))
            self.buses[star] = [1.0, 0.0, 0.0, 0.0, 0.0, V or 1.0, angle, kV]
            legs = (Z12 + Z31 - Z23) / 2, (Z12 + Z23 - Z31) / 2, (Z23 + Z31 - Z12) / 2
            out = {2.0: 1, 3.0: 2, 4.0: 0}.get(p["STATUS"])  # the winding that is open
            for j, (winding, Z) in enumerate(zip(windings, legs, strict=True)):
                if j != out:
                    self.leg(winding, Winding(star, 1.0, 0.0), Z)

    def _impedance(self, line: _Record, p: dict[str, float], at: int) -> complex:
        """That between two windings, p.u. of the case's power."""
        R, X = (line.number(name, at + j) for j, name in enumerate("RX"))
        S = line.positive("SBASE", at + 2, self.S_b)
        if p["CZ"] == 3.0:  # W, and the modulus
            R = R / 1e6 / S
            X = math.sqrt(max(X**2 - R**2, 0.0))
        return complex(R, X) * (1.0 if p["CZ"] == 1.0 else self.S_b / S)

    def _winding(self, line: _Record, k: int, unit: float) -> Winding:
        kV, tap = self.buses[k][7], line.positive("WINDV", 0, 1.0)
        if unit == 2.0:
            tap /= kV
        elif unit == 3.0:
            tap *= line.positive("NOMV", 1, kV) / kV
        return Winding(k, tap, line.number("ANG", 2))
