"""The report of one machine in docs/bench.md, from a result of ``gfmhil bench all``. Writes

    docs/tables/bench_*.md               the badge, the caveats and the tables
    docs/_static/figures/bench_*.svg     the figures

Usage: python docs/bench_report.py runs/bench-all-20260101-120000
"""

from __future__ import annotations

import sys
from pathlib import Path

from _figures.common import FIGURES, TABLES

from gfm_hil.bench.page import all_tables, badge, figures
from gfm_hil.bench.result import read_result
from gfm_hil.results.table import Table

_DRAWN = ("latency", "misses", "jitter", "lockstep")  # the kernel's says no more than its table


def markdown(table: Table) -> str:
    """A table with its heading."""
    rule = ["---", *["--:"] * (len(table.heads) - 1)]
    lines = [table.heads, rule, *table.rows]
    return f"**{table.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


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
    for name, svg in figures(content).items():
        if name in _DRAWN:
            (FIGURES / f"bench_{name}.svg").write_bytes(svg)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit("usage: python docs/bench_report.py RESULT")
    main(Path(sys.argv[1]))
