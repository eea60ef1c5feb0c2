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
        for _, block in table.blocks(_LINES):
            writer.writerows(zip(*(x.tolist() for x in block.values()), strict=True))
