"""COMTRADE, IEEE C37.111-2013, what relays and fault recorders write: a .cfg beside a .dat of
16-bit numbers, which every reader knows, or both as ASCII in one .cff.

Every column of signals.npz that is finite throughout is an analog channel in its own unit, codes
too. Whole numbers are written: 1/65 534 of a column's range apart, of ASCII 1/199 996.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.recording.columns import PHASES, ColumnLike, pieces
from gfm_hil.recording.run import Run, nominal_frequency

#: largest number by the type of the data; one more, below 0 in binary, marks a missing value
_MOST = {"BINARY": 32_767, "ASCII": 99_998}
_STAMP = 2**32 - 1  # of a sample's time


@dataclass(frozen=True)
class Analog:
    """A channel: its name and unit, and how it reads: value = a × number + b."""

    name: str
    unit: str
    column: ColumnLike
    least: float
    most: float

    def scale(self, data: str) -> tuple[float, float]:
        """a and b for a type of data."""
        middle, half = 0.5 * (self.most + self.least), 0.5 * (self.most - self.least)
        return half / _MOST[data] or 1.0, middle


def write_cfg(run: Run, file: Path) -> None:
    """Write the configuration of a run; its data goes into the .dat."""
    file.write_text(configuration(run, channels(run), "BINARY"), "utf-8", newline="")


def write_dat(run: Run, file: Path) -> None:
    """Write the data of a run as 16-bit numbers."""
    each = channels(run)
    kind = np.dtype([("n", "<u4"), ("t", "<u4"), ("x", "<i2", (len(each),))])
    with file.open("wb") as out:
        for number, values in _rows(run, each, "BINARY"):
            block = np.empty(len(values), kind)
            block["n"], block["t"], block["x"] = number + 1, _stamps(run, number), values
            out.write(block.tobytes())


def write_cff(run: Run, file: Path) -> None:
    """Write configuration and data of a run as text into one file."""
    each = channels(run)
    with file.open("w", encoding="utf-8", newline="") as out:
        text = configuration(run, each, "ASCII")
        out.write(f"--- file type: CFG ---\r\n{text}--- file type: DAT ASCII ---\r\n")
        for number, values in _rows(run, each, "ASCII"):
            block = np.column_stack([number + 1, _stamps(run, number), values])
            out.writelines(",".join(map(str, row)) + "\r\n" for row in block.tolist())


def channels(run: Run) -> list[Analog]:
    """The columns that are finite throughout."""
    found = []
    for row in run.described[: len(run.columns)]:
        column = run.columns[row.name]
        ends = [(np.min(x), np.max(x)) for x in pieces(column, 0, len(column)) if len(x)]
        low, high = (float(f(y)) for f, y in zip((min, max), zip(*ends, strict=True), strict=True))
        if row.name not in ("tick", "t") and np.isfinite([low, high]).all():
            unit = row.unit.partition(" (")[0]
            found.append(Analog(row.name, unit, column, low, high))
    return found


def configuration(run: Run, each: list[Analog], data: str) -> str:
    """The content of a .cfg; data: ``BINARY`` or ``ASCII``."""
    T_s = run.scenario.T_s
    began = datetime.now(UTC) if run.folder is None else datetime.fromtimestamp(run.began, UTC)
    first = next((float(e["t"]) for e in run.summary["events"]), 0.0)
    clock = [began, began + timedelta(seconds=first)]
    lines = [f"gfmhil,{_plain(run.scenario.title)},2013", f"{len(each)},{len(each)}A,0D"]
    for number, c in enumerate(each, 1):
        a, b = c.scale(data)
        letter = c.name.removesuffix(f"_{c.unit}")[-1:]
        phase = letter.upper() if letter in PHASES and c.unit in ("V", "A") else ""
        lines.append(
            f"{number},{c.name},{phase},,{c.unit},{a:.12g},{b:.12g},0,"
            f"{-_MOST[data]},{_MOST[data]},1,1,P"
        )
    lines += [f"{nominal_frequency(run.scenario):.9g}", "1", f"{1 / T_s:.9g},{run.ticks}"]
    lines += [t.strftime("%d/%m/%Y,%H:%M:%S.%f") for t in clock]
    lines += [data, f"{_multiple(run)}", "0,0", "F,3"]
    return "".join(f"{line}\r\n" for line in lines)


def _plain(text: str) -> str:
    """A text as one field of at most 64 characters."""
    return " ".join(text.replace(",", " ").split())[:64]


def _multiple(run: Run) -> int:
    """How many microseconds a stamp counts, so that it fits."""
    return max(1, int(np.ceil(1e6 * run.scenario.T_s * run.ticks / _STAMP)))


def _stamps(run: Run, number: Any) -> Any:
    return np.rint(1e6 * run.scenario.T_s * number / _multiple(run)).astype(np.int64)


def _rows(run: Run, each: list[Analog], data: str) -> Iterator[tuple[Any, Any]]:
    """Ticks, shape (ticks,), and the numbers of all channels, (ticks, channels), in pieces."""
    a, b = np.array([c.scale(data) for c in each]).T
    first = 0
    for rows in zip(*(pieces(c.column, 0, run.ticks) for c in each), strict=True):
        number = np.arange(first, first + len(rows[0]))
        yield number, np.rint((np.column_stack(rows) - b) / a).astype(np.int64)
        first += len(number)
