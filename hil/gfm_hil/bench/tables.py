"""The results as tables: headings, columns and cells, for a terminal and for the page."""

import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from gfm_hil.bench.contenders import ELSEWHERE
from gfm_hil.bench.histogram import SHARES
from gfm_hil.results.table import Table, shown
from gfm_hil.run.processor_time import METHODS

Row = dict[str, Any]
#: a column of a table: the key of what it shows, in a row or, after dots, in what a row has; or a
#: function that makes a cell of a row
Column = str | Callable[[Row], str]


def _table(heading: str, rows: list[Row], columns: Mapping[str, Column]) -> Table:
    def cell(row: Row, column: Column) -> str:
        return _cell(row, column) if isinstance(column, str) else column(row)

    cells = [[cell(row, column) for column in columns.values()] for row in rows]
    return Table([*columns], cells, heading)


def _cell(row: Row, key: str) -> str:
    """What a row has under a key, as its unit wants it; – for none."""
    value: Any = row
    for part in key.split("."):
        value = (value or {}).get(part)
    if key.endswith("_us"):
        return micro(value)
    if key.endswith("_pct"):
        return percent(value)
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:g}" if isinstance(value, float) else shown(value)


def micro(value: float | None) -> str:
    """A time in µs: two decimals below 10, one below 100, none above; – for none."""
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


def _median(key: str, form: str, unit: str = "") -> Column:
    """Of a ``rounds.spread``; – for none."""
    return lambda row: format(row[key]["median"], form) + unit if row[key] else "–"


def _longest(row: Row) -> str:
    bursts = row["night"]["bursts"] if "night" in row else row["bursts"]
    return str(max((length for length, _ in bursts), default=0))


_CELL: dict[str, Column] = {"": "name", "mode": "mode", "load": "load"}
_PERCENTILES: dict[str, Column] = {name.replace("_", "."): f"{name}_us" for name in SHARES}


def latency_tables(rows: list[Row]) -> Iterator[Table]:
    """Round trips, one table per mode and load, and both ways to who answers elsewhere."""
    columns: dict[str, Column] = {"": "name", "code": "code", **_PERCENTILES}
    columns |= {"n": "n", "of it the bench": "bench_us", "p50 : limit": _limit}
    for mode, load in dict.fromkeys((r["mode"], r["load"]) for r in rows):
        some = [r for r in rows if (r["mode"], r["load"]) == (mode, load)]
        conditions = f"{some[0]['policy']}, {some[0]['payload']} B"
        yield _table(f"Round trip, {mode}, {load} [µs] ({conditions})", some, columns)
    far = [row for row in rows if "sent" in row]
    if far:
        yield _table("Both ways [µs]", far, _CELL | _WAYS)


def _limit(row: Row) -> str:
    return "limit" if row["peer"] == "C" else times(row["ratio_to_baseline_p50"])


_WAYS: dict[str, Column] = {
    **{
        f"{words} {name}": f"{way}.{name}_us"
        for way, words in (("there", "there"), ("between", "its own"), ("back", "back"))
        for name in ("p50", "p99")
    },
    "± ": "within_us",
    "clock": lambda row: row.get("clock", "not read"),
    "lost": "lost_pct",
    "95 %": lambda row: "{:.3g}–{:.3g} %".format(*row["lost_pct_95"]),
}


_QUICK, _NEAR = 1.3, 2.0  # times the limit
_TICK_US = 100.0


def latency_verdicts(content: Row) -> Iterator[str]:
    """What the round trips say of each link of ours, a sentence each: its limit, the ratio to it,
    and which share of the answers came within a tick of 100 µs."""
    rows = content["results"]
    limits = {(r["name"], r["mode"], r["load"]): r for r in rows if r["peer"] == "C"}
    for row in rows:
        if row["peer"] not in ("ours", ELSEWHERE) or row["p50_us"] is None:
            continue
        text = f"{row['name']}, {row['mode']}, {row['load']}: p50 {micro(row['p50_us'])} µs"
        ratio = row["ratio_to_baseline_p50"]
        limit = limits.get((row["baseline"], row["mode"], row["load"]))
        if ratio is not None and limit is not None:
            far = f"{times(ratio)} {row['baseline']} ({micro(limit['p50_us'])} µs)"
            how = "as quick as its limit" if ratio <= _QUICK else "near its limit"
            text += f", {far}: {how if ratio <= _NEAR else 'slower than its limit'}"
        within = [share for name, share in SHARES.items() if row[f"{name}_us"] <= _TICK_US]
        if row["mode"] == "realtime":
            most = (
                f"{100 * max(within):g} % of the answers" if within else "not half of the answers"
            )
            text += f"; {most} within a tick of {_TICK_US:g} µs"
        yield text


def night_tables(rows: list[Row]) -> Iterator[Table]:
    """Of a night: how sure its percentiles are, what lies beyond them, bursts, and the worst."""
    rows = [row for row in rows if "night" in row]
    if not rows:
        return
    sure = {head: partial(_interval, f"{key}_95") for head, key in _PERCENTILES.items()}
    del sure["max"]
    yield _table("Percentiles of all times, with 95 % between [µs]", rows, _CELL | sure)
    beyond: dict[str, Column] = {
        "above": "night.beyond.threshold_us",
        "shape": "night.beyond.shape",
        "fitted to": "night.beyond.fitted",
        "one in …: longer than": _estimates,
        "longest burst": _longest,
    }
    heading = "Beyond the data: estimates by a generalised Pareto distribution [µs]"
    yield _table(heading, rows, _CELL | beyond)
    worst = [[us, at, row, why] for row in rows for at, us, why in row["night"]["worst"]]
    worst = sorted(worst, key=lambda one: -one[0])[:_WORST]
    cells = [
        [row["name"], row["mode"], row["load"], _clock_time(at), micro(us), why]
        for us, at, row, why in worst
    ]
    heads = ("", "mode", "load", "UTC", "µs", "what may have cost it")
    yield Table(heads, cells, "The ten worst times", text=None)


_WORST = 10


def _interval(key: str, row: Row) -> str:
    return "–".join("?" if end is None else micro(end) for end in row.get(key) or ())


def _estimates(row: Row) -> str:
    beyond = row["night"]["beyond"] or {"estimates": ()}
    return "; ".join(f"{times:,}: {micro(us)}" for times, us in beyond["estimates"])


def _clock_time(at: float) -> str:
    return time.strftime("%m-%d %H:%M:%S", time.gmtime(at)) + f"{at % 1:.4f}"[1:]


def jitter_tables(rows: list[Row]) -> Iterator[Table]:
    """Lateness of a loop that only paces."""
    named: dict[str, Column] = {"": "policy", "load": "load", "wait": "wait"}
    figures: dict[str, Column] = {"ticks lost": "lost_pct", "p50, p99 : nanosleep": _agrees}
    heading = "A loop that only paces, every 100 µs: late by [µs]"
    yield _table(heading, rows, named | _PERCENTILES | figures)
    heading = "Who had the processor in ticks that were late by more than 100 µs"
    yield from _named_tables(heading, rows, ("policy", "load", "wait"))


_NEARLY = 0.1  # relative difference to another program's p50 and p99 that is agreement


def _agrees(row: Row) -> str:
    """Whether another program agrees with our ``nanosleep``: the medians say so, or the rounds
    scatter too far to tell."""
    ratios = row.get("to_ours")
    if not ratios:
        return "–"
    if all(abs(middle - 1) <= _NEARLY for middle, _, _ in ratios.values()):
        verdict = "agree"
    elif any(low > 1 + _NEARLY or high < 1 - _NEARLY for _, low, high in ratios.values()):
        verdict = "differ"
    else:
        verdict = "too few rounds to tell"
    each = ", ".join(
        f"{middle:.2f} ({low:.2f}–{high:.2f})" for middle, low, high in ratios.values()
    )
    return f"{each}: {verdict}"


def realtime_tables(rows: list[Row]) -> Iterator[Table]:
    """Misses in real time, and why ticks were missed."""
    named: dict[str, Column] = {"": "link", "load": "load"}
    shares: dict[str, Column] = {
        "ticks": "ticks", "missed": "missed_pct", "the host's own": "host_pct",
        "beyond it, median": "beyond_host_pct", "by work or link": "by_work_or_link_pct",
        "trip p50 [µs]": "p50_us", "p99 [µs]": "p99_us",
    }  # fmt: skip
    yield _table("The product in real time, 10 kHz", rows, named | shares)
    causes: dict[str, Column] = {c: f"causes.{c}" for row in rows for c in row["causes"]}
    columns = named | causes | {"longest burst": _longest}
    yield _table("Missed ticks by cause", rows, columns)
    yield from _named_tables("Who had the processor in missed ticks", rows, ("link", "load"))


_NAMES = 8  # of a row, in a table


def _named_tables(heading: str, rows: list[Row], keys: tuple[str, ...]) -> Iterator[Table]:
    """Who took the time of ticks, the most frequent ones of each row."""
    named = [
        {**row, "name": name, "count": count}
        for row in rows
        for name, count in list(row.get("names", {}).items())[:_NAMES]
    ]
    if named:
        columns: dict[str, Column] = {key: key for key in keys}
        columns |= {"who": "name", "ticks": "count"}
        by = dict.fromkeys(METHODS[row["method"]] for row in named)
        yield _table(f"{heading}, {' and '.join(by)}", named, columns)


def lockstep_name(row: Row) -> str:
    """Name of a run in lockstep: its link and its loop delay."""
    return f"{row['link']}, a sample late" if row["delay_samples"] else str(row["link"])


def lockstep_tables(rows: list[Row]) -> Iterator[Table]:
    """The closed loop as fast as possible over links."""
    rates: dict[str, Column] = {
        "": lockstep_name,
        "ticks a second": _median("ticks_per_s", ",.0f"),
        "× real time": _median("times_real_time", ".1f"),
        "of what the plant alone allows": _median("share_of_plant_alone", ".0%"),
    }
    yield _table("The product in lockstep", rows, rates)


def law_tables(rows: list[Row]) -> Iterator[Table]:
    """The closed loop in one process, by law."""
    parts = ("whole", "plant", "controller", "recording")
    by_law: dict[str, Column] = {
        "": "law",
        **{part: _median(f"{part}_ns", ".0f") for part in parts},
        "× real time": _median("times_real_time", ".0f"),
        "allocations": "allocations_per_tick",
    }
    yield _table("The loop in one process: ns a tick", rows, by_law)


def kernel_tables(rows: list[Row]) -> Iterator[Table]:
    """ns per step of every law."""
    by_law: dict[str, Row] = {}
    columns: dict[str, Column] = {"": "law", "states": "states"}
    for r in rows:
        law = by_law.setdefault(r["law"], {"law": r["law"], "states": r["states"]})
        real = r["real"]
        law |= {f"{key} {real}": r[key] for key in ("numba_ns", "c_ns", "ratio")}
        columns |= {
            f"numba, {real}": _median(f"numba_ns {real}", ".1f"),
            f"C, {real}": _median(f"c_ns {real}", ".1f"),
            f"ratio, {real}": _median(f"ratio {real}", ".2f", " ×"),
        }
    yield _table("One step of the kernel [ns]", [*by_law.values()], columns)


_SWEPT: dict[str, Column] = {
    "": "name", "load": "load", "policy": "policy", "wait": "wait", "B": "payload",
}  # fmt: skip


def sweep_tables(rows: list[Row]) -> Iterator[Table]:
    """Round trips of a sweep with their cost."""
    figures: dict[str, Column] = {
        "kHz": "khz", "p50": "p50_us", "p99": "p99_us", "missed": "missed_pct",
        "processors": "processor_pct", "opened, kB": "opened_kb",
    }  # fmt: skip
    heading = "Round trips from the deadline, by payload and rate [µs]"
    yield _table(heading, rows, _SWEPT | figures)


def rate_tables(rows: list[Row]) -> Iterator[Table]:
    """The highest rates of a sweep."""
    most = percent(rows[0]["most_missed_pct"]) if rows else ""
    rate = {"kHz": lambda row: f"{row['highest_khz']:g}" if row["highest_khz"] else "none"}
    yield _table(f"Highest rate at which at most {most} miss", rows, _SWEPT | rate)
