"""CSV: one header line with the names, then a line a tick, every number exactly."""

from __future__ import annotations

import csv
from pathlib import Path

from gfm_hil.export.table import RunTable

_LINES = 10_000  # turned into Python's numbers at a time


def write_csv(table: RunTable, file: Path) -> None:
    """Write a run; a float is the shortest text that is read back as the same float."""
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(table.values)
        count = len(table.values["tick"])
        for first in range(0, count, _LINES):
            block = [x[first : first + _LINES].tolist() for x in table.values.values()]
            writer.writerows(zip(*block, strict=True))
