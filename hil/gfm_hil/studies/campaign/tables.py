"""The closing tables of a campaign on the terminal."""

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

from rich.markup import escape

from gfm_hil.core.terminal import terminal
from gfm_hil.results.report import EVENT_COLUMNS
from gfm_hil.results.table import Cell, Table
from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.campaign.result import VERDICTS, Axis, CampaignResult
from gfm_hil.studies.campaign.worker import Record

_STYLES = {"stable": "good", "oscillating": "warn"}


def print_campaign(found: CampaignResult) -> None:
    """Counts, quantiles of the stable runs' metrics, and the worst runs of every law."""
    console, result = terminal(), found.plain()
    console.print(f"[bold]{escape(result['title'])}[/]", highlight=False)
    console.print(
        f"{result['done']} runs in {found.wall_s:.1f} s on "
        + (f"{w} workers" if isinstance(w := found.workers, int) else escape(w)),
        highlight=False,
    )
    for table in counts_table(result["laws"]).fitting(console):
        console.print(table)
    for law, one in result["laws"].items():
        console.print(worst_table(law, one["worst"], [a for a in found.axes if a]))
    if found.folder is not None:
        where = f"folder: {found.folder}, figure: {found.folder / 'map.png'}"
        console.print(escape(where), soft_wrap=True)


def counts_table(laws: dict[str, Any]) -> Table:
    """How many runs of each law had each verdict, and quantiles of the stable ones' metrics."""
    rows: list[list[Any]] = []
    for name in VERDICTS:
        counts = [found["counts"][name] for found in laws.values()]
        if any(counts):
            rows.append([name.replace("-", " "), *counts])
    events = max((found["events"] for found in laws.values()), key=len)
    for k, event in enumerate(events):
        quantiles = [Cell("p5 / p50 / p95", "dim")] * len(laws)
        rows.append([Cell(f"event {k}, {event['type']}", "head"), *quantiles])
        for name, title in EVENT_COLUMNS:
            marks = [
                found["events"][k]["metrics"].get(name) if k < len(found["events"]) else None
                for found in laws.values()
            ]
            if any(marks):
                rows.append(["  " + title, *[m and _marks(m) for m in marks]])
    return Table(["", *laws], rows)


def _marks(marks: dict[str, float]) -> str:
    """Three quantiles, with as many digits as tell them apart."""
    values = [marks[name] for name in ("p5", "p50", "p95")]
    gaps = [b - a for a, b in pairwise(values) if b > a]
    digits = min(max(1 - math.floor(math.log10(min(gaps, default=1.0))), 0), 4)
    return " / ".join(f"{v:.{digits}f}" for v in values)


def worst_table(law: str, runs: list[dict[str, Any]], axes: list[Axis]) -> Table:
    """The runs of a law to look at first."""
    rows = []
    for entry in runs:
        what = entry["verdict"]
        why = reason_name(entry["reason"]) if what in ("tripped", "safe") else ""
        if what == "oscillating":
            why = f"{entry['ripple_pu']:.3g} p.u."
        words = Cell(f"{what.replace('-', ' ')} {why}".rstrip(), _STYLES.get(what, "bad"))
        drawn = [axis.text(entry["drawn"]) for axis in axes]
        rows.append([str(entry["run"]), words, entry["end_s"], *drawn])
    heads = "run", "", "at [s]", *(axis.label for axis in axes)
    return Table(heads, rows, f"\nworst of {law}", text=2)


def print_record(record: Record, folder: Path) -> None:
    """One run in a few lines."""
    console = terminal()
    reason = f" — {escape(record['reason'])}" if record["reason"] else ""
    console.print(
        f"run {record['run']}, {escape(record['law'])}: [bold]{record['status']}[/]{reason}",
        highlight=False,
    )
    drawn = ", ".join(f"{k} = {_short(v)}" for k, v in record["drawn"].items())
    console.print(escape(drawn), highlight=False)
    console.print(escape(f"folder: {folder}"), highlight=False, soft_wrap=True)


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else escape(str(value))
