"""A night of round trips: blocks on disk, of which a page can be made at any time.

``blocks.jsonl`` has a line for each block, that of one contender in one mode under one load: its
histogram, its worst times with their causes, and its bursts. A kill costs at most the block that
was being measured: a line that is cut off counts for nothing, and goes when the night goes on.
"""

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.histogram import BUCKETS, Counts, dense, histogram, of_round, sparse, summarised
from gfm_hil.bench.result import FORMAT
from gfm_hil.bench.tail import beyond, confidence
from gfm_hil.core.errors import UserError
from gfm_hil.run.attribution import bursts

WORST = 10
COLUMNS = 360  # of the heat map, at most
PER_ROW = 16  # buckets of a histogram to a row of the heat map
ROWS = BUCKETS // PER_ROW
_FILE, _SETTINGS = "blocks.jsonl", "night.json"
Cell = tuple[str, str, str]  # contender, mode, load


@dataclass
class Block:
    """What is measured of a cell between two lines of the file.

    Attributes:
        at: when it began, s since 1970.
        limit_ns: a time that counts as late: of real time the period; 0: none does.
        seconds: how long it lasted.
    """

    at: float
    limit_ns: int = 0
    counts: Counts = field(default_factory=lambda: np.zeros(BUCKETS, np.int64))
    worst: list[tuple[float, float, str]] = field(default_factory=list)  # (at, µs, cause)
    bursts: Counter[int] = field(default_factory=Counter)
    seconds: float = 0.0

    def add(self, times_ns: NDArray[np.int64], at: float, cause: str) -> None:
        """Take the times of a round in, when it began, and what cost its worst."""
        late = np.flatnonzero(times_ns > self.limit_ns) if self.limit_ns else times_ns[:0]
        events = times_ns
        if len(late):
            # a burst is one event, as bad as its worst
            starts = np.flatnonzero(np.diff(late, prepend=-2) != 1)
            events = times_ns.copy()
            events[late] = 0
            events[late[starts]] = np.maximum.reduceat(times_ns[late], starts)
        top = np.argpartition(events, -min(WORST, len(events)))[-WORST:]
        since = self.limit_ns * top if self.limit_ns else np.cumsum(times_ns)[top]
        each = zip((at + 1e-9 * since).tolist(), (events[top] / 1e3).tolist(), strict=True)
        worst = [(place, us, cause) for place, us in each]
        self.merge(histogram(times_ns), worst, dict(bursts([late])))

    def merge(self, counts: Counts, worst: Sequence[Any], lengths: dict[int, int]) -> None:
        """Take other times in: their histogram, the worst ones, and the bursts by their length."""
        self.counts += counts
        self.worst = sorted([*self.worst, *worst], key=lambda event: -event[1])[:WORST]
        self.bursts.update(lengths)

    def line(self, cell: Cell) -> str:
        """For the file."""
        content = {
            "cell": cell, "at": round(self.at, 3), "s": round(self.seconds, 3),
            "histogram": sparse(self.counts), "bursts": sorted(self.bursts.items()),
            "worst": [(round(at, 4), round(us, 3), cause) for at, us, cause in self.worst],
        }  # fmt: skip
        return json.dumps(content, separators=(",", ":")) + "\n"


class Blocks:
    """The file of a night. Raises UserError: there is no night to go on with, or it has other
    settings.

    Args:
        folder: of the result.
        settings: what is measured; a night that goes on must have the same.
        about: what its page says besides, see ``night_of``.
        resume: go on with what is there.
    """

    def __init__(
        self, folder: Path, settings: dict[str, Any], about: dict[str, Any], resume: bool
    ) -> None:
        path = folder / _FILE
        if resume:
            known = settings_of(folder)
            for key, value in settings.items():
                if known.get(key) != value:
                    raise UserError(f"--resume: {key} was {known.get(key)!r}, and is {value!r} now")
            os.truncate(path, path.read_bytes().rfind(b"\n") + 1)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps(settings | about, indent=1) + "\n"
            (folder / _SETTINGS).write_text(text, encoding="utf-8")
            path.write_bytes(b"")
        self._file = path.open("ab")
        self.close = self._file.close

    def append(self, cell: Cell, block: Block) -> None:
        """Write a block; it is on the disk when this returns."""
        self._file.write(block.line(cell).encode())
        self._file.flush()
        os.fsync(self._file.fileno())


def settings_of(folder: Path) -> dict[str, Any]:
    """What a night measures. Raises UserError: the folder holds none."""
    try:
        return dict(json.loads((folder / _SETTINGS).read_text(encoding="utf-8")))
    except (OSError, ValueError) as problem:
        raise UserError(f"{folder}: holds no night: {problem}") from None


def holds_night(folder: Path) -> bool:
    """Whether a folder is that of a night."""
    return (folder / _SETTINGS).exists()


def lines_of(folder: Path) -> Iterator[dict[str, Any]]:
    """The blocks of a night, one after the other. Raises UserError: the file is damaged."""
    path = folder / _FILE
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if not line.endswith(b"\n"):  # it is being written, or was cut off
                return
            try:
                yield json.loads(line)
            except ValueError as problem:
                raise UserError(f"{path}, line {number}: {problem}") from None


class CellNight:
    """One cell's night, however long, in bounded memory."""

    def __init__(self) -> None:
        self.whole = Block(0.0)
        self.each: list[list[float]] = []  # ``of_round`` of each block
        self._heat: list[tuple[float, NDArray[np.int64]]] = []
        self._together = 1  # blocks of a column

    def add(self, block: dict[str, Any]) -> None:
        """Take a block in, as ``lines_of`` gives it."""
        self.whole.seconds += block["s"]
        if not block["histogram"]:  # nobody answered
            return
        counts = dense(block["histogram"])
        self.each.append(of_round(counts))
        self.whole.merge(counts, block["worst"], {int(k): int(n) for k, n in block["bursts"]})
        column = counts.reshape(ROWS, PER_ROW).sum(axis=1)
        if (len(self.each) - 1) % self._together:
            self._heat[-1][1][:] += column
            return
        if len(self._heat) == COLUMNS:
            pairs = zip(self._heat[::2], self._heat[1::2], strict=True)
            self._heat = [(at, a + b) for (at, a), (_, b) in pairs]
            self._together *= 2
        self._heat.append((block["at"], column))

    def row(self, cell: Cell) -> dict[str, Any]:
        """The row of a result, with ``night``: what a short measurement has not."""
        name, mode, load = cell
        whole = self.whole
        return {
            "name": name, "mode": mode, "load": load,
            **summarised(whole.counts, self.each), **confidence(whole.counts),
            "night": {
                "worst": whole.worst, "bursts": sorted(whole.bursts.items()),
                "beyond": beyond(whole.counts), "measured_s": round(whole.seconds, 1),
                "heat": {
                    "at": [at for at, _ in self._heat],
                    "counts": [sparse(column) for _, column in self._heat],
                },
            },
        }  # fmt: skip


def night_of(folder: Path) -> dict[str, Any]:
    """The result of a night as it stands, also while it is measured. Raises UserError: there is
    none."""
    settings = settings_of(folder)
    cells: dict[Cell, CellNight] = {}
    for block in lines_of(folder):
        name, mode, load = block["cell"]
        cells.setdefault((name, mode, load), CellNight()).add(block)
    rows = [
        {
            "policy": settings["policy"], "payload": settings["payload"], "baseline": None,
            "ratio_to_baseline_p50": None, "rounds_ratio": [], "silent_rounds": 0,
            **settings["contenders"][cell[0]], **one.row(cell),
        }
        for cell, one in cells.items()
    ]  # fmt: skip
    return {
        "format": FORMAT, "bench": "latency", "results": rows, "remarks": [],
        "environment": settings["environment"], "caveats": settings["caveats"],
        "seconds": round(sum(one.whole.seconds for one in cells.values()), 1),
    }  # fmt: skip
