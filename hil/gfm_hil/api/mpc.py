"""Power-flow cases of MATPOWER (.m, version 2) as nets of pandapower.

A file is a function of MATLAB that puts numbers and matrices in brackets into the fields of mpc; a
row of a matrix ends with a semicolon or its line. Fields that no power flow needs are passed over,
and statements that compute are refused. The model of a branch is that of MATPOWER's manual: a
transformer at its from bus, and behind it the impedance with half of the charging at either side.
"""

import math
import re
from pathlib import Path

from gfm_hil.api.case_tables import CaseTables, Winding
from gfm_hil.api.dyr import number
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import lines_of

_F = 60.0  # Hz; as .raw files have it that name none
#: where the columns of a matrix are that are read here
_COLUMNS = {
    "bus": {"BUS_I": 0, "BUS_TYPE": 1, "PD": 2, "QD": 3, "GS": 4, "BS": 5, "VM": 7, "VA": 8,
            "BASE_KV": 9},
    "gen": {"GEN_BUS": 0, "PG": 1, "QG": 2, "VG": 5, "MBASE": 6, "GEN_STATUS": 7, "PMAX": 8},
    "branch": {"F_BUS": 0, "T_BUS": 1, "BR_R": 2, "BR_X": 3, "BR_B": 4, "TAP": 8, "SHIFT": 9,
               "BR_STATUS": 10},
}  # fmt: skip
_ASSIGNMENT = re.compile(r"\s*mpc\.(\w+)\s*=\s*([\[{]?)(.*)")
_COMMENT = re.compile(r"((?:'[^']*'|[^%])*)%?.*")
_NUMBER = re.compile(r"[+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|inf|nan)", re.IGNORECASE)
_AROUND = re.compile(r"\s*(?:function\b.*|(?:end|return)\s*;?\s*)?")


def _fields(path: Path) -> dict[str, list[tuple[str, list[str]]]]:
    """The rows of the matrices of a file, and its numbers and texts as such of one: file, line and
    field, and numbers."""
    fields: dict[str, list[tuple[str, list[str]]]] = {}
    name, closing = "", ""
    for k, whole in enumerate(lines_of(path), 1):
        line = _COMMENT.fullmatch(whole)[1]  # type: ignore[index]
        match = _ASSIGNMENT.fullmatch(line)
        if closing and match:
            raise UserError(f"{path}, line {k}: mpc.{name[:40]} does not end with {closing}")
        if not closing:
            if match is None:
                if not _AROUND.fullmatch(line):
                    text = line.strip()[:40]
                    raise UserError(f"{path}, line {k}: {text!r}: only mpc.NAME = numbers is read")
                continue
            name, line, closing = match[1], match[3], {"[": "]", "{": "}", "": ""}[match[2]]
            fields[name] = []
        content, end, rest = line.strip("; "), "", ""
        if closing:
            content, end, rest = re.sub("'[^']*'", "''", line).partition(closing)
        for row in content.split(";"):
            if numbers := row.replace(",", " ").split():
                fields[name].append((f"{path}, line {k}, mpc.{name}", numbers))
        closing = "" if end else closing
        if rest := rest.strip("; ")[:40]:
            raise UserError(f"{path}, line {k}: {rest!r}: only one mpc.NAME = ... a line is read")
    if closing:
        raise UserError(f"{path}: mpc.{name[:40]} does not end with {closing}")
    return fields


class MpcCase(CaseTables):
    """A case of MATPOWER.

    Args:
        path: of the file.
        frequency: nominal, Hz, which a file does not have; None: 60, and ``ignored`` says so.

    Raises:
        UserError: the file cannot be read, is of another version, computes, or a row is none; the
            message has the file, the line and the column. The frequency is not above 0.
    """

    def __init__(self, path: Path, frequency: float | None = None) -> None:
        if frequency is not None and not 0.0 < frequency < math.inf:
            raise UserError(f"frequency = {frequency:g}: must be above 0 Hz")
        self.path, self.fields = path, _fields(path)
        (_, texts), *_ = self.fields.get("version") or [("", ["1"])]
        version = " ".join(texts).strip("'")
        if version != "2":
            raise UserError(f"{path}: mpc.version = {version[:40]!r}: must be '2'")
        for name in ("baseMVA", *_COLUMNS):
            if not self.fields.get(name):
                raise UserError(f"{path}: has no mpc.{name}")
        where, texts = self.fields["baseMVA"][0]
        S_b = number(where, " ".join(texts))
        if S_b <= 0.0:
            raise UserError(f"{where}: {S_b:g}: must be above 0")
        super().__init__(S_b, frequency or _F)
        if frequency is None:
            self.ignored.append(
                f"{_F:g} Hz is our assumption: a file of MATPOWER has no frequency."
            )
        self._fill()

    def _rows(self, name: str) -> list[tuple[str, dict[str, float]]]:
        """The columns of each row of a matrix by their names."""
        columns, rows = _COLUMNS[name], []
        # all rows are as long as the first one
        width = max(max(columns.values()) + 1, len(self.fields[name][0][1]))
        for where, texts in self.fields[name]:
            for text in texts:
                if not _NUMBER.fullmatch(text):
                    raise UserError(f"{where}: {text[:40]!r} is no number")
            if len(texts) != width:
                raise UserError(f"{where}: must have {width} numbers, not {len(texts)}")
            if name == "gen" and texts[columns["PMAX"]].lower() == "inf":
                texts[columns["PMAX"]] = "0"  # it says nothing of a rating
            row = {one: number(f"{where}, {one}", texts[at]) for one, at in columns.items()}
            rows.append((where, row))
        return rows

    def _fill(self) -> None:
        numbers = set[float]()  # of all buses, isolated ones too
        for _, p in self._rows("bus"):
            numbers.add(p["BUS_I"])
            if p["BUS_TYPE"] != 4.0:  # isolated
                self.buses[int(p["BUS_I"])] = [
                    p["BUS_TYPE"], p["PD"], p["QD"], p["GS"], p["BS"], p["VM"], p["VA"],
                    p["BASE_KV"] if p["BASE_KV"] > 0.0 else 1.0,
                ]  # fmt: skip
        for name, status, ends in (
            ("gen", "GEN_STATUS", ("GEN_BUS",)),
            ("branch", "BR_STATUS", ("F_BUS", "T_BUS")),
        ):
            for where, p in self._rows(name):
                for end in ends:
                    if p[end] not in numbers:
                        raise UserError(f"{where}, {end}: {p[end]:g}: there is no such bus")
                if p[status] > 0.0 and all(p[end] in self.buses for end in ends):
                    self._generator(p) if name == "gen" else self._branch(where, p)
        for k, bus in self.buses.items():
            if bus[0] == 2.0 and k not in self.generators:
                bus[0] = 1.0  # its generators are out of service
        self.join_series_capacitors()
        if lines := len(self.fields.get("dcline", ())):
            self.ignored.append(f"{lines} dcline{'s' * (lines > 1)}: left out.")

    def _generator(self, p: dict[str, float]) -> None:
        """One that holds the voltage of its bus; elsewhere P and Q come as from a load. Its rating
        is the largest of MBASE, which most files leave at the power of the case, PMAX, and what PG
        and QG are together."""
        k = int(p["GEN_BUS"])
        bus = self.buses[k]
        if bus[0] == 1.0:
            bus[1] -= p["PG"]
            bus[2] -= p["QG"]
            return
        if k not in self.generators:
            bus[5] = p["VG"]
        P, S, _ = self.generators.get(k, (0.0, 0.0, 0.0))
        S += max(p["MBASE"], p["PMAX"], abs(complex(p["PG"], p["QG"]))) or self.S_b
        self.generators[k] = (P + p["PG"], S, math.inf)

    def _branch(self, where: str, p: dict[str, float]) -> None:
        a, b, Z = int(p["F_BUS"]), int(p["T_BUS"]), complex(p["BR_R"], p["BR_X"])
        tap = p["TAP"] or 1.0
        if not Z or tap < 0.0:
            raise UserError(f"{where}: BR_R, BR_X = 0, or TAP = {tap:g}: must be above 0")
        if tap == 1.0 and not p["SHIFT"]:
            self.branches.append([a, b, Z.real, Z.imag, p["BR_B"], 0.0, 0.0])
            return
        for k, ratio in ((a, tap), (b, 1.0)):
            self.shunt(k, 0.5j * p["BR_B"] / ratio**2 * self.S_b)
        self.leg(Winding(a, tap, p["SHIFT"]), Winding(b, 1.0, 0.0), Z)
