"""COMTRADE, IEEE C37.111-2013, what relays and fault recorders write: a .cfg beside a .dat of
32-bit floats, or both as ASCII in one .cff.

Every column of signals.npz that is finite throughout is an analog channel in its own unit, codes
too. ASCII holds whole numbers, 1/200 000 of a column's range apart.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.recording.columns import PHASES, ColumnLike, pieces
from gfm_hil.recording.run import Run, nominal_frequency

_MOST = 99_998  # of a value in ASCII; 99999 marks one that is missing
_STAMP = 2**32 - 1  # of a sample's time


@dataclass(frozen=True)
class Analog:
    """A channel: its name and unit, and how it reads: value = a × number + b."""

    name: str
    unit: str
    column: ColumnLike
    least: float
    most: float

    @property
    def scale(self) -> tuple[float, float]:
        """a and b of ASCII."""
        middle, half = 0.5 * (self.most + self.least), 0.5 * (self.most - self.least)
        return half / _MOST or 1.0, middle


def write_cfg(run: Run, file: Path) -> None:
    """Write the configuration of a run; its data goes into the .dat."""
    file.write_text(configuration(run, channels(run), ascii_data=False), "utf-8", newline="")


def write_dat(run: Run, file: Path) -> None:
    """Write the data of a run as 32-bit floats."""
    each = channels(run)
    kind = np.dtype([("n", "<u4"), ("t", "<u4"), ("x", "<f4", (len(each),))])
    with file.open("wb") as out:
        for first, rows in _rows(run, each):
            block = np.empty(len(rows), kind)
            number = np.arange(first, first + len(rows))
            block["n"], block["t"], block["x"] = number + 1, _stamps(run, number), rows
            out.write(block.tobytes())


def write_cff(run: Run, file: Path) -> None:
    """Write configuration and data of a run as text into one file."""
    each = channels(run)
    a, b = np.array([c.scale for c in each]).T
    with file.open("w", encoding="utf-8", newline="") as out:
        text = configuration(run, each, ascii_data=True)
        out.write(f"--- file type: CFG ---\r\n{text}--- file type: DAT ASCII ---\r\n")
        for first, rows in _rows(run, each):
            number = np.arange(first, first + len(rows))
            values = np.rint((rows - b) / a).astype(int)
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


def configuration(run: Run, each: list[Analog], ascii_data: bool) -> str:
    """The content of a .cfg."""
    T_s = run.scenario.T_s
    began = datetime.now(UTC) if run.folder is None else datetime.fromtimestamp(run.began, UTC)
    first = next((float(e["t"]) for e in run.summary["events"]), 0.0)
    clock = [began, began + timedelta(seconds=first)]
    lines = [f"gfmhil,{_plain(run.scenario.title)},2013", f"{len(each)},{len(each)}A,0D"]
    for number, c in enumerate(each, 1):
        a, b = c.scale if ascii_data else (1.0, 0.0)
        ends = (-_MOST, _MOST) if ascii_data else (c.least, c.most)
        letter = c.name.removesuffix(f"_{c.unit}")[-1:]
        phase = letter.upper() if letter in PHASES and c.unit in ("V", "A") else ""
        lines.append(
            f"{number},{c.name},{phase},,{c.unit},{a:.12g},{b:.12g},0,"
            f"{ends[0]:.9g},{ends[1]:.9g},1,1,P"
        )
    lines += [f"{nominal_frequency(run.scenario):.9g}", "1", f"{1 / T_s:.9g},{run.ticks}"]
    lines += [t.strftime("%d/%m/%Y,%H:%M:%S.%f") for t in clock]
    lines += ["ASCII" if ascii_data else "FLOAT32", f"{_multiple(run)}", "0,0", "F,3"]
    return "".join(f"{line}\r\n" for line in lines)


def _plain(text: str) -> str:
    """A text as one field of at most 64 characters."""
    return " ".join(text.replace(",", " ").split())[:64]


def _multiple(run: Run) -> int:
    """How many microseconds a stamp counts, so that it fits."""
    return max(1, int(np.ceil(1e6 * run.scenario.T_s * run.ticks / _STAMP)))


def _stamps(run: Run, number: Any) -> Any:
    return np.rint(1e6 * run.scenario.T_s * number / _multiple(run)).astype(np.int64)


def _rows(run: Run, each: list[Analog]) -> Iterator[tuple[int, Any]]:
    """The values of all channels in pieces: the first tick of each, and shape (ticks, channels)."""
    first = 0
    for rows in zip(*(pieces(c.column, 0, run.ticks) for c in each), strict=True):
        yield first, np.column_stack(rows)
        first += len(rows[0])
