"""The closing tables of a campaign on the terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from gfm_hil.core.terminal import fitting, numbers, terminal
from gfm_hil.results.report import EVENT_COLUMNS, cell
from gfm_hil.scenario.expectation import reason_name
from gfm_hil.studies.campaign.axes import Axis
from gfm_hil.studies.campaign.result import VERDICTS, CampaignResult
from gfm_hil.studies.campaign.worker import Record

_COLOURS = {"stable": "green", "oscillating": "yellow"}


def print_campaign(found: CampaignResult) -> None:
    """Counts, quantiles of the stable runs' metrics, and the worst runs of every law."""
    console, result = terminal(), found.plain()
    console.print(f"[bold]{escape(result['title'])}[/]", highlight=False)
    console.print(
        f"{result['done']} runs in {found.wall_s:.1f} s on "
        + (f"{w} workers" if isinstance(w := found.workers, int) else escape(w)),
        highlight=False,
    )
    for table in fitting(console, list(result["laws"]), partial(_counts, result["laws"])):
        console.print(table)
    for law, one in result["laws"].items():
        console.print(_worst(law, one["worst"], [a for a in found.axes if a]))
    if found.folder is not None:
        where = f"folder: {found.folder}, figure: {found.folder / 'map.png'}"
        console.print(escape(where), soft_wrap=True)


def _counts(all_laws: dict[str, Any], names: Sequence[str]) -> Table:
    laws = {name: all_laws[name] for name in names}
    table = numbers("", *map(escape, laws))
    for name in VERDICTS:
        counts = [found["counts"][name] for found in laws.values()]
        if any(counts):
            table.add_row(name.replace("-", " "), *[str(n) for n in counts])
    events = max((found["events"] for found in laws.values()), key=len)
    for k, event in enumerate(events):
        table.add_row(
            f"[bold]event {k}, {event['type']}[/]", *["[dim]p5 / p50 / p95[/]"] * len(laws)
        )
        for name, title in EVENT_COLUMNS:
            marks = [
                found["events"][k]["metrics"].get(name) if k < len(found["events"]) else None
                for found in laws.values()
            ]
            if any(marks):
                table.add_row("  " + escape(title), *[_marks(m) if m else "–" for m in marks])
    return table


def _marks(marks: dict[str, float]) -> str:
    """Three quantiles, with as many digits as tell them apart."""
    values = [marks[name] for name in ("p5", "p50", "p95")]
    gaps = [b - a for a, b in pairwise(values) if b > a]
    digits = min(max(1 - math.floor(math.log10(min(gaps, default=1.0))), 0), 4)
    return " / ".join(f"{v:.{digits}f}" for v in values)


def _worst(law: str, runs: list[dict[str, Any]], axes: list[Axis]) -> Table:
    table = Table(box=None, pad_edge=False, title=f"\nworst of {escape(law)}", title_justify="left")
    for name in ("run", "at \\[s]", *(escape(axis.label) for axis in axes)):
        table.add_column(name, justify="right")
    table.add_column("")
    for entry in runs:
        what = entry["verdict"]
        why = escape(reason_name(entry["reason"])) if what in ("tripped", "safe") else ""
        if what == "oscillating":
            why = f"{entry['ripple_pu']:.3g} p.u."
        words = f"[{_COLOURS.get(what, 'red')}]{what.replace('-', ' ')}[/] {why}"
        drawn = [axis.shown(entry["drawn"]) for axis in axes]
        table.add_row(str(entry["run"]), cell(entry["end_s"]), *drawn, words)
    return table


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
