"""MATLAB's file, version 5, which Octave reads as well: a variable a column, and what it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.export.table import RunTable, event_text
from gfm_hil.npz import Column


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
