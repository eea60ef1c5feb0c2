"""Parquet: a column a column, units and comments as metadata of the fields."""

from __future__ import annotations

import json
from pathlib import Path

from gfm_hil.export.table import RunTable


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
    parquet.write_table(
        pa.table(list(table.values.values()), schema=pa.schema(fields, metadata=about)),
        file,
        compression="zstd",
        use_dictionary=False,
        column_encoding="BYTE_STREAM_SPLIT",
    )
