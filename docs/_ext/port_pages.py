"""The page about ports and files: the registry, formats, columns and metrics, from the code."""

from __future__ import annotations

from gfm_hil.core.terminal import markdown
from gfm_hil.ports import PORTS, make_port
from gfm_hil.ports.streams.port import METRICS
from gfm_hil.recording.columns import TABLE
from gfm_hil.results.export import FORMATS


def ports() -> str:
    """A row a port."""
    rows = []
    for name, entry in PORTS.items():
        made = make_port(name)
        needs = f"`pip install 'gfmhil[{made.needs[3]}]'`" if made.needs else "–"
        rows.append((f"`{name}`", entry.text, str(entry.number), f"`{made.opens[0]}`", needs))
    return markdown(("port", "", "number", "to open it unencrypted", "needs"), rows)


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
    rows = [(f"`{n}`", f"`{m}`" if m else "–", text) for n, (m, text) in METRICS.items()]
    return markdown(("metric", "label", ""), rows)
