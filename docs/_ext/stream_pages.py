"""The page about streams and files: formats, columns and metrics, from the code."""

from __future__ import annotations

from gfm_hil.core.terminal import markdown
from gfm_hil.ports.streams.metrics import METRICS
from gfm_hil.recording.columns import TABLE
from gfm_hil.results.export import FORMATS


def export_formats() -> str:
    """A row a format."""
    rows = [(f"`{name}`", f.text, f.needs or "–") for name, f in FORMATS.items()]
    return markdown(("format", "", "needs"), rows)


def columns() -> str:
    """A row a column of the recording."""
    rows = [
        (f"`{name}`", f"${row.symbol}$" if row.symbol else "–", row.unit or "–", row.comment)
        for name, row in TABLE.items()
    ]
    return markdown(("column", "symbol", "unit", ""), rows)


def metrics() -> str:
    """A row a metric."""
    rows = [(f"`{n}`", f"`{m.label}`" if m.label else "–", m.text) for n, m in METRICS.items()]
    return markdown(("metric", "label", ""), rows)
