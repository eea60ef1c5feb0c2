"""The results as tables: headings, columns and cells, for a terminal and for the page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from gfm_hil.bench.histogram import SHARES

PERCENTILES = tuple(SHARES)


@dataclass(frozen=True)
class Table:
    """One table; the first column is text, the others are numbers."""

    heading: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]


def title(percentile: str) -> str:
    """The usual notation of a percentile: p99.9."""
    return percentile.replace("_", ".")


def micro(value: float | None) -> str:
    """A number with three significant digits; – for none."""
    if value is None:
        return "–"
    if value >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def times(value: float | None, unit: str = " ×") -> str:
    """A ratio; – for none."""
    return "–" if value is None else f"{value:.2f}{unit}"


def percent(value: float | None) -> str:
    """A share in percent; – for none."""
    return "–" if value is None else f"{value:.3g} %"


def tables(content: dict[str, Any]) -> Iterator[tuple[str, Table]]:
    """All tables of a result, each with its section of the page."""
    for table in latency_tables(content["results"]):
        yield "latency", table
    loop = content.get("loop", {})
    if "realtime" in loop:
        yield "misses", realtime_table(loop["realtime"])
        yield "misses", causes_table(loop["realtime"])
    if "jitter" in content:
        yield "jitter", jitter_table(content["jitter"])
    if "lockstep" in loop:
        yield "lockstep", lockstep_table(loop["lockstep"])
        yield "lockstep", laws_table(loop["laws"])
    if "kernel" in content:
        yield "kernel", kernel_table(content["kernel"])


def latency_tables(rows: list[dict[str, Any]]) -> Iterator[Table]:
    """Round trips, one table per mode and load."""
    for mode, load in dict.fromkeys((r["mode"], r["load"]) for r in rows):
        some = [r for r in rows if (r["mode"], r["load"]) == (mode, load)]
        yield Table(
            f"Round trip, {mode}, {load} [µs] ({some[0]['policy']}, {some[0]['payload']} B)",
            ("", "code", *map(title, PERCENTILES), "n", "p50 : limit"),
            [
                (
                    r["name"], r["code"], *(micro(r[f"{p}_us"]) for p in PERCENTILES),
                    f"{r['n']:,}",
                    times(r["ratio_to_baseline_p50"]) if r["peer"] != "C" else "limit",
                )
                for r in some
            ],
        )  # fmt: skip


def jitter_table(rows: list[dict[str, Any]]) -> Table:
    """Lateness of a loop that only paces."""
    return Table(
        "A loop that only paces, every 100 µs: late by [µs]",
        ("", "load", "wait", *map(title, PERCENTILES), "ticks lost"),
        [
            (
                r["policy"], r["load"], r["wait"], *(micro(r[f"{p}_us"]) for p in PERCENTILES),
                percent(r["lost_pct"]),
            )
            for r in rows
        ],
    )  # fmt: skip


def realtime_table(rows: list[dict[str, Any]]) -> Table:
    """Misses in real time."""
    return Table(
        "The product in real time, 10 kHz",
        (
            "", "load", "ticks", "missed", "the host's own", "beyond it, median", "by work or link",
            "trip p50 [µs]", "p99 [µs]",
        ),
        [
            (
                r["link"], r["load"], f"{r['ticks']:,}", percent(r["missed_pct"]),
                percent(r["host_pct"]), percent(r["beyond_host_pct"]),
                percent(r["by_work_or_link_pct"]), micro(r["p50_us"]), micro(r["p99_us"]),
            )
            for r in rows
        ],
    )  # fmt: skip


def causes_table(rows: list[dict[str, Any]]) -> Table:
    """Why ticks were missed."""
    causes = tuple(rows[0]["causes"]) if rows else ()
    return Table(
        "Missed ticks by cause",
        ("", "load", *causes, "longest burst"),
        [
            (
                r["link"], r["load"], *(f"{r['causes'][c]:,}" for c in causes),
                str(max((length for length, _ in r["bursts"]), default=0)),
            )
            for r in rows
        ],
    )  # fmt: skip


def lockstep_name(row: dict[str, Any]) -> str:
    """Name of a run in lockstep: its link and its loop delay."""
    return f"{row['link']}, a sample late" if row["delay_samples"] else str(row["link"])


def lockstep_table(rows: list[dict[str, Any]]) -> Table:
    """The closed loop as fast as possible."""
    return Table(
        "The product in lockstep",
        ("", "ticks a second", "× real time", "of what the plant alone allows"),
        [
            (
                lockstep_name(r), f"{r['ticks_per_s']['median']:,.0f}",
                f"{r['times_real_time']['median']:.1f}",
                f"{r['share_of_plant_alone']['median']:.0%}",
            )
            for r in rows
        ],
    )  # fmt: skip


def laws_table(rows: list[dict[str, Any]]) -> Table:
    """The loop in one process, by law."""
    parts = ("whole", "plant", "controller", "recording")
    return Table(
        "The loop in one process: ns a tick",
        ("", *parts, "× real time", "allocations"),
        [
            (
                r["law"], *(f"{r[f'{part}_ns']['median']:.0f}" for part in parts),
                f"{r['times_real_time']['median']:.0f}", f"{r['allocations_per_tick']:g}",
            )
            for r in rows
        ],
    )  # fmt: skip


def kernel_table(rows: list[dict[str, Any]]) -> Table:
    """ns per step of every law."""
    reals = list(dict.fromkeys(r["real"] for r in rows))
    by = {(r["law"], r["real"]): r for r in rows}

    def cells(law: str) -> Iterator[str]:
        for real in reals:
            r = by[law, real]
            yield f"{r['numba_ns']['median']:.1f}"
            yield f"{r['c_ns']['median']:.1f}" if r["c_ns"] else "–"
            yield times(r["ratio"]["median"]) if r["ratio"] else "–"

    columns = [f"{what}, {real}" for real in reals for what in ("numba", "C", "ratio")]
    return Table(
        "One step of the kernel [ns]",
        ("", "states", *columns),
        [
            (law, str(by[law, reals[0]]["states"]), *cells(law))
            for law in dict.fromkeys(r["law"] for r in rows)
        ],
    )
