"""bench.html: a result as one self-contained file."""

from __future__ import annotations

import base64
import html
from pathlib import Path
from typing import Any

from gfm_hil.bench import tables
from gfm_hil.bench.plots import figures
from gfm_hil.results.report import html_table

_STYLE = """
body{font:15px/1.55 system-ui,sans-serif;max-width:76rem;margin:2rem auto;padding:0 1.2rem;
color:#222;background:#fff}
h1{font-size:1.5rem;margin:0 0 .2rem} h2{font-size:1.15rem;margin:2.4rem 0 .3rem}
p{max-width:52rem;margin:.4rem 0} .dim{color:#666;font-size:.9rem}
.badge{display:flex;flex-wrap:wrap;gap:.4rem;margin:1rem 0}
.badge span{border:1px solid #d8d8d8;border-radius:.4rem;padding:.1rem .55rem;font-size:.82rem}
.badge b{font-weight:500;color:#666;margin-right:.35rem}
.badge .warn{border-color:#d09000;background:#fff6e0}
.cards{display:flex;flex-wrap:wrap;gap:.8rem;margin:.8rem 0}
.card{border:1px solid #e0e0e0;border-radius:.6rem;padding:.6rem 1rem;min-width:11rem}
.card .v{font-size:1.45rem;font-variant-numeric:tabular-nums} .card .t{font-size:.82rem;color:#666}
table{border-collapse:collapse;margin:.5rem 0 1.2rem;font-size:.88rem}
caption{text-align:left;font-weight:600;padding:.2rem 0}
th,td{padding:.18rem .9rem .18rem 0;text-align:right;border-bottom:1px solid #ececec;
font-variant-numeric:tabular-nums;white-space:nowrap} th{font-weight:500;color:#666}
th:first-child,td:first-child{text-align:left} td.limit{color:#888} .scroll{overflow-x:auto}
img{max-width:100%;display:block;margin:.6rem 0} li{max-width:52rem}
"""

_BADGE = (
    ("cpu", "CPU"), ("cpus", "CPUs"), ("kernel", "kernel"), ("preemption", "preemption"),
    ("virtual_machine", "virtual machine"), ("container", "container"),
    ("steal_pct", "stolen by the host, %"), ("sched_fifo", "SCHED_FIFO"), ("mlock", "mlock"),
    ("rt_throttling", "real-time throttling"), ("isolated_cpus", "isolated CPUs"),
    ("governor", "governor"), ("clock_source", "clock"), ("load_average", "load average"),
    ("python", "Python"), ("numba", "numba"), ("numpy", "numpy"), ("pyzmq", "pyzmq"),
    ("libzmq", "libzmq"), ("gfmhil", "gfmhil"),
)  # fmt: skip

_SECTIONS = {
    "latency": (
        "Round trips",
        "A message and its answer, between two processes on two processors. Solid: the "
        "links of the bench; dashed: the limit, the same exchange in C, in the same rounds. "
        "lockstep: one after the other. realtime: one every 100 µs, counted from its deadline, so "
        "that a late start is part of it. busy: another process computes on each processor.",
    ),
    "misses": (
        "Real time",
        "The product at 10 kHz: ticks whose answer had not come by the next deadline, and why. The "
        "mark is what a loop that only waits for its ticks lost on the same processors right "
        "before and after the run: no link can avoid these misses.",
    ),
    "jitter": (
        "Pacing",
        "A loop that waits for the next deadline and does nothing else, on both processors at a "
        "time. The line is the period: beyond it a whole tick is lost. The kernel stops a "
        "SCHED_FIFO thread that only spins for 5 % of each second, so the bench sleeps first and "
        "then spins.",
    ),
    "lockstep": (
        "Lockstep",
        "The closed loop in simulated time, as fast as possible, and the rate that the plant's "
        "arithmetic alone allows. inproc: both sides in one compiled loop, without a link.",
    ),
    "kernel": (
        "Kernel",
        "One step of the controller for every law, each waiting for the previous one, and the "
        "same step in C, as gfmhil firmware export writes it, with the same bits as result.",
    ),
}


def write_page(content: dict[str, Any], path: Path) -> None:
    """Write the page of a result, and its figures as files in the same folder."""
    made = figures(content)
    for name, svg in made.items():
        path.with_name(f"{name}.svg").write_bytes(svg)
    by_section: dict[str, list[str]] = {name: [] for name in _SECTIONS}
    for section, table in tables.tables(content):
        by_section[section].append(html_table(table.columns, table.rows, table.heading))
    parts = []
    for name, (heading, text) in _SECTIONS.items():
        if not by_section[name]:
            continue
        parts.append(f"<h2>{heading}</h2><p>{html.escape(text)}</p>")
        if name in made:
            uri = base64.b64encode(made[name]).decode()
            parts.append(f'<img alt="{heading}" src="data:image/svg+xml;base64,{uri}">')
        parts += by_section[name]
    points = "".join(
        f"<li>{html.escape(x)}</li>" for x in (*content["caveats"], *content["remarks"])
    )
    path.write_text(
        f"""<!doctype html><html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>gfmhil bench</title><style>{_STYLE}</style>
<h1>gfmhil bench {html.escape(content["bench"])}</h1>
<p class="dim">measured in {content["seconds"]:g} s, in interleaved rounds: p50, p90 and p99 are
medians over them, what is beyond p99 is of all rounds together; a ratio is taken round by round</p>
<div class="badge">{_badge(content["environment"])}</div>
{_cards(content)}
{"".join(parts)}
<h2>What to keep in mind</h2><ul>{points}
<li>Absolute times are this machine's at this moment; ratios within the run are what carries over.
</li></ul></html>
""",
        encoding="utf-8",
    )


def _badge(environment: dict[str, Any]) -> str:
    bad = {
        "virtual_machine": lambda v: v != "no",
        "sched_fifo": lambda v: not v,
        "steal_pct": lambda v: (v or 0) > 0.1,
        "load_average": lambda v: v[0] > environment["cpus"] / 2,
    }
    said = {True: "yes", False: "no"}
    chips = []
    for key, label in _BADGE:
        value = environment.get(key)
        if value is None:
            continue
        text = said.get(value, value) if isinstance(value, bool) else value
        text = " ".join(map(str, text)) if isinstance(text, list) else str(text)
        warn = ' class="warn"' if key in bad and bad[key](value) else ""
        chips.append(f"<span{warn}><b>{label}</b>{html.escape(text)}</span>")
    return "".join(chips)


def _cards(content: dict[str, Any]) -> str:
    """The most important figures, one line per kind."""
    loop = content.get("loop", {})
    trips = [
        (f"{tables.micro(r['p50_us'])} µs", _compared(r))
        for r in content["results"]
        if (r["peer"], r["code"], r["mode"], r["load"]) == ("ours", "compiled", "lockstep", "idle")
    ]
    misses = [
        (
            tables.percent(r["missed_pct"]),
            f"{r['link']}, {r['load']}: ticks missed, host alone {tables.percent(r['host_pct'])}",
        )
        for r in loop.get("realtime", ())
    ]
    rates = [
        (
            f"{r['times_real_time']['median']:.3g} ×",
            f"{tables.lockstep_name(r)}: times real time, lockstep",
        )
        for r in loop.get("lockstep", ())
    ]
    lines = []
    for cards in filter(None, (trips, misses, rates)):
        drawn = "".join(
            f'<div class="card"><div class="v">{html.escape(value)}</div>'
            f'<div class="t">{html.escape(text)}</div></div>'
            for value, text in cards
        )
        lines.append(f'<div class="cards">{drawn}</div>')
    return "".join(lines)


def _compared(row: dict[str, Any]) -> str:
    ratio = row["ratio_to_baseline_p50"]
    return f"{row['name']}: round trip" + (f", {tables.times(ratio)} the limit" if ratio else "")
