"""bench.html: a result as one self-contained file."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from gfm_hil.bench import plots, tables
from gfm_hil.results import page
from gfm_hil.results.table import Table

_STYLE = """
.dim{opacity:.7;font-size:.9rem}
.badge,.cards{display:flex;flex-wrap:wrap;gap:.5rem;margin:1rem 0}
.badge span,.card{border:1px solid var(--line);border-radius:.4rem;padding:.1rem .55rem}
.badge{font-size:.82rem} .badge b{font-weight:500;opacity:.7;margin-right:.35rem}
.badge .warn{border-color:var(--wrong);color:var(--wrong)}
.card{padding:.6rem 1rem;min-width:11rem} .card .v{font-size:1.45rem} .card .t{font-size:.82rem}
img{max-width:100%}
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


@dataclass(frozen=True)
class Section:
    """A part of the page, of which there may be nothing in a result.

    Attributes:
        name: of its figure's file.
        heading, text: what it shows.
        tables, figure: made of a result.
    """

    name: str
    heading: str
    text: str
    tables: Callable[[dict[str, Any]], Iterator[Table]]
    figure: Callable[[dict[str, Any]], Figure | None]


SECTIONS = (
    Section(
        "latency",
        "Round trips",
        "A message and its answer, between two processes on two processors. Solid: the "
        "links of the bench; dashed: the limit, the same exchange in C, in the same rounds. "
        "lockstep: one after the other. realtime: one every 100 µs, counted from its deadline, so "
        "that a late start is part of it. busy: another process computes on each processor.",
        tables.latency_tables,
        plots.latency,
    ),
    Section(
        "misses",
        "Real time",
        "The product at 10 kHz: ticks whose answer had not come by the next deadline, and why. The "
        "mark is what a loop that only waits for its ticks lost on the same processors right "
        "before and after the run: no link can avoid these misses.",
        tables.realtime_tables,
        plots.misses,
    ),
    Section(
        "jitter",
        "Pacing",
        "A loop that waits for the next deadline and does nothing else, on both processors at a "
        "time. The line is the period: beyond it a whole tick is lost. The kernel stops a "
        "SCHED_FIFO thread that only spins for 5 % of each second, so the bench sleeps first and "
        "then spins.",
        tables.jitter_tables,
        plots.jitter,
    ),
    Section(
        "lockstep",
        "Lockstep",
        "The closed loop in simulated time, as fast as possible, and the rate that the plant's "
        "arithmetic alone allows. inproc: both sides in one compiled loop, without a link.",
        tables.lockstep_tables,
        plots.lockstep,
    ),
    Section(
        "kernel",
        "Kernel",
        "One step of the controller for every law, each waiting for the previous one, and the "
        "same step in C, as gfmhil firmware export writes it, with the same bits as result.",
        tables.kernel_tables,
        plots.kernel,
    ),
)


def all_tables(content: dict[str, Any]) -> Iterator[tuple[str, Table]]:
    """All tables of a result, each with the name of its section."""
    return ((section.name, table) for section in SECTIONS for table in section.tables(content))


def figures(content: dict[str, Any]) -> dict[str, bytes]:
    """Every figure that a result has data for: name and SVG."""
    drawn = {section.name: section.figure(content) for section in SECTIONS}
    return {name: _svg(figure) for name, figure in drawn.items() if figure is not None}


def _svg(figure: Figure) -> bytes:
    out = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "gfmhil"}):  # equal results give equal bytes
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def write_page(content: dict[str, Any], path: Path) -> None:
    """Write the page of a result, and its figures as files in the same folder."""
    images = figures(content)
    for name, svg in images.items():
        path.with_name(f"{name}.svg").write_bytes(svg)
    page.write_page(
        path,
        "bench.html",
        title=f"gfmhil bench {content['bench']}",
        style=_STYLE,
        seconds=content["seconds"],
        badge=badge(content["environment"]),
        cards=_cards(content),
        sections=[
            (s, s.name in images and page.inline(images[s.name], "svg+xml"), [*s.tables(content)])
            for s in SECTIONS
        ],
        points=[*content["caveats"], *content["remarks"]],
    )


def badge(environment: dict[str, Any]) -> Iterator[tuple[str, str, bool]]:
    """What times depend on, as (label, text, whether it is a reason for caution)."""
    caution = {
        "virtual_machine": lambda v: v != "no",
        "sched_fifo": lambda v: not v,
        "steal_pct": lambda v: (v or 0) > 0.1,
        "load_average": lambda v: v[0] > environment["cpus"] / 2,
    }
    for key, label in _BADGE:
        value = environment.get(key)
        if value is None:
            continue
        if isinstance(value, bool):
            text = "yes" if value else "no"
        else:
            text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
        yield label, text, key in caution and caution[key](value)


def _cards(content: dict[str, Any]) -> list[list[tuple[str, str]]]:
    """The most important figures as (value, text), one line per kind."""
    loop = content.get("loop", {})
    trips = [
        (f"{tables.micro(r['p50_us'])} µs", f"{r['name']}: round trip{_compared(r)}")
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
    return [trips, misses, rates]


def _compared(row: dict[str, Any]) -> str:
    ratio = row["ratio_to_baseline_p50"]
    return f", {tables.times(ratio)} the limit" if ratio else ""
