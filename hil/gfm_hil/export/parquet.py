"""Parquet: a column a column, units and comments as metadata of the fields."""

from __future__ import annotations

import json
from pathlib import Path

from gfm_hil.export.table import RunTable

_ROWS = 1 << 17  # of a row group, which is held in memory


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
