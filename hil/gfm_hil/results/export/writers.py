"""CSV, MAT and Parquet: what a library writes, in a page of ours each."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.recording.npz import Column
from gfm_hil.results.export.table import RunTable, event_text

_LINES = 10_000  # of CSV, turned into Python's numbers at a time
_ROWS = 1 << 17  # of a row group of Parquet, which is held in memory


def write_csv(table: RunTable, file: Path) -> None:
    """Write one header line with the names, then a line a tick. A float is the shortest text that
    is read back as the same float."""
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(table.values)
        for _, block in table.blocks(_LINES):
            writer.writerows(zip(*(x.tolist() for x in block.values()), strict=True))


def write_mat(table: RunTable, file: Path) -> None:
    """Write a run: columns as variables (ticks, 1), ``unit``, ``comment`` and ``words`` as structs
    with a field a column, ``laws``, ``events`` and ``scenario``."""
    from scipy.io import savemat

    def cells(texts: list[str]) -> Any:
        return np.array(texts, dtype=object).reshape(-1, 1)

    content: dict[str, Any] = {}
    content["unit"] = {c.name: c.unit for c in table.columns}
    content["comment"] = {c.name: c.comment for c in table.columns}
    content["words"] = {
        c.name: {
            "value": np.array([value for value, _ in c.words]).reshape(-1, 1),
            "text": cells([text for _, text in c.words]),
        }
        for c in table.columns
        if c.words
    }
    content["laws"] = cells(table.laws)
    content["events"] = {
        "tick": np.array([e["tick"] for e in table.events]).reshape(-1, 1),
        "t": np.array([e["t"] for e in table.events]).reshape(-1, 1),
        "event": cells([e["event"] for e in table.events]),
        "text": cells([event_text(e) for e in table.events]),
    }
    content["scenario"] = table.text("scenario.toml")
    variables = _OneByOne(table.values, content)
    savemat(file, variables, appendmat=False, long_field_names=True, do_compression=True)


class _OneByOne(dict[str, Any]):
    """Variables for ``savemat``, which asks for each in its turn: no two columns are in memory."""

    def __init__(self, columns: dict[str, Column], content: dict[str, Any]) -> None:
        super().__init__(content)
        self._columns = columns

    def items(self) -> Any:
        for name, column in self._columns.items():
            yield name, column[:].reshape(-1, 1)
        yield from super().items()


def write_parquet(table: RunTable, file: Path) -> None:
    """Write a run; laws, events, summary and scenario lie in the file's own metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    fields = [
        pa.field(
            c.name,
            pa.from_numpy_dtype(table.values[c.name].dtype),
            nullable=False,
            metadata={"unit": c.unit, "comment": c.comment, "words": json.dumps(dict(c.words))},
        )
        for c in table.columns
    ]
    about = {
        "laws": json.dumps(table.laws),
        "events": json.dumps(table.events),
        "summary": json.dumps(table.summary),
        "scenario": table.text("scenario.toml"),
    }
    # columns of smoothly changing numbers: bytes of one place beside each other compress well
    schema = pa.schema(fields, metadata=about)
    with parquet.ParquetWriter(
        file,
        schema,
        compression="zstd",
        use_dictionary=False,
        column_encoding="BYTE_STREAM_SPLIT",
    ) as writer:
        for _, block in table.blocks(_ROWS):
            writer.write_table(pa.table(list(block.values()), schema=schema))
