"""The report of one machine in docs/bench.md, from a result of ``gfmhil bench all``. Writes

    docs/tables/bench_*.md               the badge, the caveats and the tables
    docs/_static/figures/bench_*.svg     the figures

Usage: python docs/bench_report.py runs/bench-all-20260101-120000
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from _figures.common import FIGURES, TABLES

from gfm_hil.bench import tables
from gfm_hil.bench.plots import figures
from gfm_hil.bench.result import read_result

_DRAWN = ("latency", "misses", "jitter", "lockstep")  # the kernel's says no more than its table
_BADGE = {
    "cpu": "CPU", "cpus": "CPUs", "kernel": "kernel", "preemption": "preemption",
    "virtual_machine": "virtual machine", "steal_pct": "% stolen by its host",
    "sched_fifo": "SCHED_FIFO", "isolated_cpus": "isolated CPUs", "load_average": "load average",
    "python": "Python", "numba": "numba", "libzmq": "libzmq",
}  # fmt: skip


def markdown(table: tables.Table) -> str:
    """A table with its heading."""
    rule = ["---", *["--:"] * (len(table.columns) - 1)]
    lines = [table.columns, rule, *table.rows]
    return f"**{table.heading}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def text_of(value: Any) -> str:
    """A value of the badge as people write it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def main(folder: Path) -> None:
    """Write everything."""
    content = read_result(folder)
    if content["bench"] != "all":
        raise SystemExit(f"{folder}: of `gfmhil bench {content['bench']}`, not of `all`")
    parts: dict[str, str] = {}
    for section, table in tables.tables(content):
        parts[section] = "\n\n".join(filter(None, (parts.get(section), markdown(table))))
    parts["realtime"] = parts.pop("misses")
    badge = content["environment"]
    chips = (f"{label} {text_of(badge[key])}" for key, label in _BADGE.items())
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
