"""The report of one machine in docs/bench.md, from a result of ``gfmhil bench all``. Writes

    docs/tables/bench_*.md               the badge, the caveats and the tables
    docs/_static/figures/bench_*.svg     the figures
    README.md                            the table between its two marks

Usage: python docs/bench_report.py runs/bench-all-20260101-120000
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from _figures.common import FIGURES, TABLES

from gfm_hil.bench.page import all_tables, badge, figures
from gfm_hil.bench.result import read_result
from gfm_hil.bench.tables import micro, percent, times
from gfm_hil.core.terminal import markdown as lines_of
from gfm_hil.results.table import Table

README = Path(__file__).resolve().parents[1] / "README.md"
MARKS = "<!-- latency: docs/bench_report.py writes this table -->", "<!-- end of latency -->"
_DRAWN = ("latency", "misses", "jitter", "lockstep")  # the kernel's says no more than its table


def markdown(table: Table) -> str:
    """A table with its heading."""
    rule = ["---", *["--:"] * (len(table.heads) - 1)]
    lines = [table.heads, rule, *table.rows]
    return f"**{table.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def front_page(content: dict[str, Any]) -> str:
    """The table of the front page: each link of ours in real time on the idle machine."""
    trips = {
        row["link"]: row
        for row in content["results"]
        if (row["name"], row["peer"]) in ((row["link"], "ours"), (f"{row['link']} ipc", "ours"))
        and (row["mode"], row["load"]) == ("realtime", "idle")
    }
    rows = []
    for loop in content["loop"]["realtime"]:
        trip = trips.get(loop["link"])
        if trip is None or loop["load"] != "idle":
            continue
        ratio, us = trip["ratio_to_baseline_p50"], (micro(trip[f"{p}_us"]) for p in ("p50", "p99"))
        missed = percent(loop["missed_pct"]), percent(loop["by_work_or_link_pct"])
        rows.append([f"`{loop['link']}`", *us, times(ratio), *missed])
    heads = ["link", "p50, µs", "p99, µs", "p50 : C", "ticks missed", "by work or link"]
    load = content["environment"]["load_average"][0]
    return f"{lines_of(heads, rows)}\n\n*Load average at the start {load:g}.*"


def main(folder: Path) -> None:
    """Write everything."""
    content = read_result(folder)
    if content["bench"] != "all":
        raise SystemExit(f"{folder}: of `gfmhil bench {content['bench']}`, not of `all`")
    parts: dict[str, str] = {}
    for section, table in all_tables(content):
        parts[section] = "\n\n".join(filter(None, (parts.get(section), markdown(table))))
    parts["realtime"] = parts.pop("misses")
    chips = (f"{label} {text}" for label, text, _ in badge(content["environment"]))
    parts["badge"] = f"{'; '.join(chips)}. Measured in {content['seconds']:g} s."
    parts["caveats"] = "\n".join(f"- {x}" for x in (*content["caveats"], *content["remarks"]))
    for name, text in parts.items():
        (TABLES / f"bench_{name}.md").write_text(text + "\n", encoding="utf-8")
    readme = README.read_text(encoding="utf-8")
    before, rest = readme.split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    text = "".join([before, MARKS[0], "\n\n", front_page(content), "\n\n", MARKS[1], after])
    README.write_text(text, encoding="utf-8")
    for name, svg in figures(content).items():
        if name in _DRAWN:
            (FIGURES / f"bench_{name}.svg").write_bytes(svg)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/bench_report.py RESULT")
    main(Path(sys.argv[1]))
