"""Laws of a dynamic data file of PSS/E (.dyr): its records of REGFM_A1 and REGFM_B1.

A record is free text that ends with a slash: the number of a bus, a name in quotes, the number of a
machine, and the model's numbers. A model of the user's library has the name USRMDL, its own name
behind the machine, and then six integers before its numbers.
"""

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from gfm_hil.api.law import Law
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import lines_of
from gfm_hil.scenario import toml_text
from gfm_runtime import LawError


class _Model(NamedTuple):
    law: str
    flags: tuple[str, ...]  # those with which the law is the model
    numbers: tuple[str, ...]  # their names, in the order of a record
    above_0: tuple[str, ...]
    at_0: tuple[str, ...]


MODELS = {
    "REGFMA1": _Model(
        "regfm-a1",
        ("1", "1"),
        ("TPf", "TQf", "TVf", "Imax", "Emax", "Emin", "Pmax", "Pmin", "Qmax", "Qmin", "mp", "mq",
         "kppmax", "kipmax", "kpqmax", "kiqmax", "kpv", "kiv"),
        ("TPf", "TQf", "TVf", "Imax", "Emax", "mp"),
        (),
    ),
    "REGFMB1": _Model(
        "regfm-b1",
        ("0", "0", "1", "1", "1", "1"),
        ("mq", "kpv", "kiv", "mp", "Dwmax", "Dwmin", "kpPLL", "kiPLL", "DwPLLmax", "DwPLLmin", "Tp",
         "H", "D1", "D2", "omega_D", "ImaxSS", "kf", "kI", "ImaxF", "TPf", "TQf", "TVf", "TIf",
         "Ke", "VPLLfrz"),
        ("mp", "H", "omega_D", "DwPLLmax", "ImaxSS", "kf", "ImaxF", "TPf", "TQf", "Dwmax"),
        ("Tp", "TVf", "TIf"),
    ),
}  # fmt: skip
_TOKEN = re.compile(r"'([^']*)'|([^\s,/]+)|(/)")


class Record(NamedTuple):
    """A record of a model that is a law here."""

    where: str  #: file and line
    model: str  #: REGFMA1 or REGFMB1
    bus: int
    machine: str
    numbers: dict[str, float]  #: by their names in the model's documents

    def law(self, R_e: float, X_L: float) -> Law:
        """Its law.

        Args:
            R_e, X_L: source impedance of the machine, p.u. of its power; a record has it not.

        Raises:
            UserError: a number that makes no law.
        """
        law = Law.load(MODELS[self.model].law)
        content = law.file.model_dump(mode="json", exclude_none=True)
        values = self.numbers | {"R_e": R_e, "X_L": X_L}
        for name, value in values.items():
            if name in content["parameters"]:
                content["parameters"][name] |= {"value": value, "source": self.where}
        if "Dwmax" in values:
            content["limits"]["omega_u"] = [1.0 + values["Dwmin"], 1.0 + values["Dwmax"]]
        content["name"] = f"{law.name}-bus-{self.bus}-{self.machine.lower()}"
        try:
            made = Law.from_toml(toml_text(content))
            made.built()
        except LawError as problem:
            raise UserError(f"{self.where}: {'; '.join(problem.lines)}") from None
        return made


def read_dyr(path: str | Path) -> list[Record]:
    """The records of REGFM_A1 and REGFM_B1 in a dynamic data file; others are left out.

    Raises:
        UserError: it cannot be read, has none of them, or a record is none; the message has the
            file, the line and the field.
    """
    found = [one for one in (_record(path, *r) for r in records(path)) if one is not None]
    if not found:
        raise UserError(f"{path}: no record of {' or '.join(MODELS)}")
    return found


def records(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """The line at which each record of a file begins, and its fields. Raises UserError: it cannot
    be read, or its last record does not end."""
    begin, fields = 0, list[str]()
    for number, line in enumerate(lines_of(path), 1):
        for quoted, bare, end in _TOKEN.findall(line.split("//")[0]):
            if end:
                if fields:
                    yield begin, fields
                fields = []
                break  # what follows the slash is a comment
            begin = begin if fields else number
            fields.append(quoted.strip() if quoted else bare)
    if fields:
        raise UserError(f"{path}, line {begin}: the record does not end with a slash")


def _record(path: str | Path, line: int, fields: list[str]) -> Record | None:
    where = f"{path}, line {line}"
    names = [name.upper() for name in fields[1:4]]
    name, skip = (names[2], 10) if len(names) > 2 and names[0] == "USRMDL" else ("", 3)
    name = (name or (names[0] if names else "")).replace("_", "")[:7]
    if name not in MODELS:
        return None
    model = MODELS[name]
    if not fields[0].isdecimal():
        raise UserError(f"{where}, bus: {fields[0]!r} is no number of a bus")
    machine = fields[2] if len(fields) > 2 else ""
    if not re.fullmatch("[A-Za-z0-9]{1,2}", machine):
        raise UserError(f"{where}, machine: {machine!r} is not one or two letters or digits")
    given, count = fields[skip:], len(model.flags) + len(model.numbers)
    if len(given) != count:
        raise UserError(f"{where}: {name} has {count} numbers behind its name, not {len(given)}")
    flags = tuple(given[: len(model.flags)])
    if flags != model.flags:
        known, own = " ".join(model.flags), " ".join(flags)
        raise UserError(f"{where}, flags: {own}: only {known} is a law here")
    numbers = {}
    for field, value in zip(model.numbers, given[len(flags) :], strict=True):
        numbers[field] = number(f"{where}, {field}", value)
        if field in model.above_0 and not numbers[field] > 0.0:
            raise UserError(f"{where}, {field}: {value} must be > 0")
        if field in model.at_0 and numbers[field]:
            raise UserError(f"{where}, {field}: {value}: only 0 is a law here")
    for low, high in (("Dwmin", "Dwmax"), ("DwPLLmin", "DwPLLmax")):
        if low in numbers and numbers[low] != -numbers[high]:
            raise UserError(f"{where}, {low}: {numbers[low]:g} must be -{high}, {-numbers[high]:g}")
    return Record(where, name, int(fields[0]), machine, numbers)


def number(where: str, text: str) -> float:
    """A number of a record. Raises UserError: it is none that a model has."""
    try:
        value = float(re.sub("[dD]", "e", text))
    except ValueError:
        value = math.nan
    if not abs(value) <= 1e6:
        raise UserError(f"{where}: {text[:40]!r} is no number from -1e6 to 1e6")
    return value
