"""The page about streams and files: formats, columns and metrics, from the code."""

from __future__ import annotations

from gfm_hil.recording.columns import TABLE
from gfm_hil.results.export import FORMATS
from gfm_hil.telemetry.metrics import METRICS


def export_formats() -> str:
    """A row a format."""
    rows = ["| format | | needs |", "|---|---|---|"]
    rows += [f"| `{name}` | {f.text} | {f.needs or '–'} |" for name, f in FORMATS.items()]
    return "\n".join(rows)


def columns() -> str:
    """A row a column of the recording."""
    rows = ["| column | symbol | unit | |", "|---|---|---|---|"]
    for name, row in TABLE.items():
        symbol = f"${row.symbol}$" if row.symbol else "–"
        rows.append(f"| `{name}` | {symbol} | {row.unit or '–'} | {row.comment} |")
    return "\n".join(rows)


def metrics() -> str:
    """A row a metric."""
    rows = ["| metric | label | |", "|---|---|---|"]
    for name, metric in METRICS.items():
        label = f"`{metric.label}`" if metric.label else "–"
        rows.append(f"| `{name}` | {label} | {metric.text} |")
    return "\n".join(rows)
