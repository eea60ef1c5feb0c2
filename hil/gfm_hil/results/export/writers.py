"""CSV, MAT and Parquet: what a library writes, in a page of ours each."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.recording.columns import Columns
from gfm_hil.recording.log import event_text
from gfm_hil.recording.run import Run

_LINES = 10_000  # of CSV, turned into Python's numbers at a time
_ROWS = 1 << 17  # of a row group of Parquet, which is held in memory


def write_csv(run: Run, file: Path) -> None:
    """Write one header line with the names, then a line a tick. A float is the shortest text that
    is read back as the same float."""
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(run.recorded)
        for _, block in run.blocks(_LINES):
            writer.writerows(zip(*(x.tolist() for x in block.values()), strict=True))


def write_mat(run: Run, file: Path) -> None:
    """Write a run: columns as variables (ticks, 1), ``unit``, ``comment`` and ``words`` as structs
    with a field a column, ``laws``, ``events`` and ``scenario``."""
    from scipy.io import savemat

    def cells(texts: list[str]) -> Any:
        return np.array(texts, dtype=object).reshape(-1, 1)

    content: dict[str, Any] = {}
    content["unit"] = {c.name: c.unit for c in run.described}
    content["comment"] = {c.name: c.comment for c in run.described}
    content["words"] = {
        c.name: {
            "value": np.array([value for value, _ in c.words]).reshape(-1, 1),
            "text": cells([text for _, text in c.words]),
        }
        for c in run.described
        if c.words
    }
    content["laws"] = cells(run.laws)
    content["events"] = {
        "tick": np.array([e["tick"] for e in run.events]).reshape(-1, 1),
        "t": np.array([e["t"] for e in run.events]).reshape(-1, 1),
        "event": cells([e["event"] for e in run.events]),
        "text": cells([event_text(e) for e in run.events]),
    }
    content["scenario"] = run.text("scenario.toml")
    variables = _OneByOne(run.recorded, content)
    savemat(file, variables, appendmat=False, long_field_names=True, do_compression=True)


class _OneByOne(dict[str, Any]):
    """Variables for ``savemat``, which asks for each in its turn: no two columns are in memory."""

    def __init__(self, columns: Columns, content: dict[str, Any]) -> None:
        super().__init__(content)
        self._columns = columns

    def items(self) -> Any:
        for name, column in self._columns.items():
            yield name, column[:].reshape(-1, 1)
        yield from super().items()


def write_parquet(run: Run, file: Path) -> None:
    """Write a run; laws, events, summary and scenario lie in the file's own metadata."""
    import pyarrow as pa
    from pyarrow import parquet

    fields = [
        pa.field(
            c.name,
            pa.from_numpy_dtype(run.recorded[c.name].dtype),
            nullable=False,
            metadata={"unit": c.unit, "comment": c.comment, "words": json.dumps(dict(c.words))},
        )
        for c in run.described
    ]
    about = {
        "laws": json.dumps(run.laws),
        "events": json.dumps(run.events),
        "summary": json.dumps(run.summary),
        "scenario": run.text("scenario.toml"),
    }
    # columns of smoothly changing numbers: bytes of one place beside each other compress well
    schema = pa.schema(fields, metadata=about)
    with parquet.ParquetWriter(
        file, schema, compression="zstd", use_dictionary=False, column_encoding="BYTE_STREAM_SPLIT"
    ) as writer:
        for _, block in run.blocks(_ROWS):
            writer.write_table(pa.table(list(block.values()), schema=schema))
