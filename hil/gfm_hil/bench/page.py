"""bench.html: a result as one self-contained file."""

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl

from gfm_hil.bench import plots, tables
from gfm_hil.bench.result import rows_of
from gfm_hil.results import page
from gfm_hil.results.table import Table

_BADGE = {
    "cpu": "CPU", "cpus": "CPUs", "kernel": "kernel", "preemption": "preemption",
    "virtual_machine": "virtual machine", "container": "container",
    "steal_pct": "stolen by the host, %", "sched_fifo": "SCHED_FIFO", "mlock": "mlock",
    "rt_throttling": "real-time throttling", "isolated_cpus": "isolated CPUs",
    "governor": "governor", "clock_source": "clock", "load_average": "load average",
    "python": "Python", "numba": "numba", "numpy": "numpy", "pyzmq": "pyzmq", "libzmq": "libzmq",
    "gfmhil": "gfmhil",
}  # fmt: skip
#: of each section of the page the figure, of the first rows, and the tables by the name of theirs
_SECTIONS = {
    "latency": (plots.latency, {"results": tables.latency_tables}),
    "night": (plots.night, {"results": tables.night_tables}),
    "misses": (plots.misses, {"realtime": tables.realtime_tables}),
    "jitter": (plots.jitter, {"jitter": tables.jitter_tables}),
    "lockstep": (plots.lockstep, {"lockstep": tables.lockstep_tables, "laws": tables.law_tables}),
    "kernel": (plots.kernel, {"kernel": tables.kernel_tables}),
    "sweep": (plots.sweep, {"sweep": tables.sweep_tables, "highest": tables.rate_tables}),
}


def all_tables(content: dict[str, Any]) -> Iterator[tuple[str, Table]]:
    """All tables of a result, each with the name of its section."""
    for section, (_, makers) in _SECTIONS.items():
        for name, make in makers.items():
            rows = rows_of(content, name)
            yield from ((section, table) for table in (() if rows is None else make(rows)))


def figures(content: dict[str, Any]) -> dict[str, bytes]:
    """Every figure that a result has data for, by its section, as SVG."""
    drawn = {}
    for section, (draw, makers) in _SECTIONS.items():
        rows = rows_of(content, next(iter(makers)))
        if rows and (figure := draw(rows)) is not None:
            out = io.BytesIO()
            with mpl.rc_context({"svg.hashsalt": "gfmhil"}):  # equal results give equal bytes
                figure.savefig(out, format="svg", metadata={"Date": None})
            drawn[section] = out.getvalue()
    return drawn


def write_page(content: dict[str, Any], path: Path) -> None:
    """Write the page of a result, and its figures as files in the same folder."""
    images, made = figures(content), [*all_tables(content)]
    for name, svg in images.items():
        path.with_name(f"{name}.svg").write_bytes(svg)
    page.write_page(
        path,
        "bench.html",
        title=f"gfmhil bench {content['bench']}",
        seconds=content["seconds"],
        badge=badge(content["environment"]),
        cards=_cards(content),
        sections=[
            (
                name,
                name in images and page.inline(images[name], "svg+xml"),
                [table for section, table in made if section == name],
            )
            for name in _SECTIONS
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
    for key, label in _BADGE.items():
        value = environment.get(key)
        if value is None:
            continue
        if isinstance(value, bool):
            text = "yes" if value else "no"
        else:
            text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
        yield label, text, key in caution and caution[key](value)


def _cards(content: dict[str, Any]) -> Iterator[list[tuple[str, str]]]:
    """The most important figures as (value, text), one line per kind."""
    trips = []
    for r in content["results"]:
        if (r["peer"], r["code"], r["mode"], r["load"]) == ("ours", "compiled", "lockstep", "idle"):
            ratio = r["ratio_to_baseline_p50"]
            compared = f", {tables.times(ratio)} the limit" if ratio else ""
            trips.append((f"{tables.micro(r['p50_us'])} µs", f"{r['name']}: round trip{compared}"))
    yield trips
    yield [
        (
            tables.percent(r["missed_pct"]),
            f"{r['link']}, {r['load']}: ticks missed, host alone {tables.percent(r['host_pct'])}",
        )
        for r in rows_of(content, "realtime") or ()
    ]
    yield [
        (
            f"{r['times_real_time']['median']:.3g} ×",
            f"{tables.lockstep_name(r)}: times real time, lockstep",
        )
        for r in rows_of(content, "lockstep") or ()
    ]
