"""The results as tables on a terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.markup import escape
from rich.table import Table

PERCENTILES = ("p50", "p90", "p99", "p99_9", "p99_99", "max")


def title(percentile: str) -> str:
    """As people write it: p99.9."""
    return percentile.replace("_", ".")


def micro(value: float | None) -> str:
    """µs with three significant digits; – for none."""
    if value is None:
        return "–"
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def times(value: float | None) -> str:
    """A ratio; – for none."""
    return "–" if value is None else f"{value:.2f} ×"


def _table(heading: str, *columns: str) -> Table:
    table = Table(title=heading, title_justify="left", box=None, pad_edge=False)
    for k, column in enumerate(columns):
        table.add_column(escape(column), justify="right" if k else "left", no_wrap=True)
    return table


def latency_tables(rows: list[dict[str, Any]]) -> Iterator[Table]:
    """One table a mode and load."""
    for mode, load in dict.fromkeys((r["mode"], r["load"]) for r in rows):
        some = [r for r in rows if (r["mode"], r["load"]) == (mode, load)]
        heading = f"round trip [µs], {mode}, {load}, {some[0]['policy']}, {some[0]['payload']} B"
        table = _table(heading, "", "code", *map(title, PERCENTILES), "n", "× limit")
        for r in some:
            table.add_row(
                escape(r["name"]), r["code"], *(micro(r[f"{p}_us"]) for p in PERCENTILES),
                f"{r['n']:,}", times(r["ratio_to_baseline_p50"]) if r["peer"] != "C" else "limit",
            )  # fmt: skip
        yield table


def tables(content: dict[str, Any]) -> Iterator[Table]:
    """Everything that a result holds."""
    yield from latency_tables(content["results"])
