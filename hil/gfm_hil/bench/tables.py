"""The results as tables: headings, columns and cells, for a terminal and for the page."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from gfm_hil.bench.contenders import ELSEWHERE
from gfm_hil.bench.histogram import SHARES
from gfm_hil.results.table import Table, shown
from gfm_hil.run.taken import METHODS

Row = dict[str, Any]
#: a column of a table: the key of what it shows as it is, or a function that makes a cell of a row
Column = str | Callable[[Row], str]


def _table(heading: str, rows: list[Row], columns: Mapping[str, Column]) -> Table:
    def cell(row: Row, column: Column) -> str:
        return str(row[column]) if isinstance(column, str) else column(row)

    cells = [[cell(row, column) for column in columns.values()] for row in rows]
    return Table([*columns], cells, heading)


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


def _of(show: Callable[[Any], str], *keys: str) -> Column:
    """What a row has under a key, or under one within another: None if it is not there."""

    def cell(row: Row) -> str:
        value: Any = row
        for key in keys:
            value = (value or {}).get(key)
        return show(value)

    return cell


def _median(key: str, form: str, unit: str = "") -> Column:
    """Of a ``rounds.spread``; – for none."""
    return lambda row: format(row[key]["median"], form) + unit if row[key] else "–"


def _longest(bursts: list[tuple[int, int]]) -> str:
    return str(max((length for length, _ in bursts), default=0))


_CELL: dict[str, Column] = {"": "name", "mode": "mode", "load": "load"}
_PERCENTILES = {name.replace("_", "."): _of(micro, f"{name}_us") for name in SHARES}


def latency_tables(rows: list[Row]) -> Iterator[Table]:
    """Round trips, one table per mode and load, and both ways to who answers elsewhere."""
    columns: dict[str, Column] = {
        "": "name",
        "code": "code",
        **_PERCENTILES,
        "n": _of("{:,}".format, "n"),
        "of it the bench": _of(micro, "bench_us"),
        "p50 : limit": _limit,
    }
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
    f"{words} {name}": _of(micro, way, f"{name}_us")
    for way, words in (("there", "there"), ("between", "its own"), ("back", "back"))
    for name in ("p50", "p99")
} | {
    "± ": _of(micro, "within_us"),
    "clock": lambda row: row.get("clock", "not read"),
    "lost": _of(percent, "lost_pct"),
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
    sure = {
        name.replace("_", "."): _of(_interval, f"{name}_us_95") for name in SHARES if name != "max"
    }
    yield _table("Percentiles of all times, with 95 % between [µs]", rows, _CELL | sure)
    beyond = {
        "above": _of(micro, "night", "beyond", "threshold_us"),
        "shape": _of(shown, "night", "beyond", "shape"),
        "fitted to": _of(shown, "night", "beyond", "fitted"),
        "one in …: longer than": _of(_estimates, "night", "beyond", "estimates"),
        "longest burst": _of(_longest, "night", "bursts"),
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


def _interval(ends: list[float | None] | None) -> str:
    return "–".join("?" if end is None else micro(end) for end in ends or ())


def _estimates(estimates: list[tuple[int, float]] | None) -> str:
    return "; ".join(f"{times:,}: {micro(us)}" for times, us in estimates or ())


def _clock_time(at: float) -> str:
    return time.strftime("%m-%d %H:%M:%S", time.gmtime(at)) + f"{at % 1:.4f}"[1:]


def jitter_tables(rows: list[Row]) -> Iterator[Table]:
    """Lateness of a loop that only paces."""
    named: dict[str, Column] = {"": "policy", "load": "load", "wait": "wait"}
    figures = {"ticks lost": _of(percent, "lost_pct"), "p50, p99 : nanosleep": _agrees}
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
    shares = {
        "ticks": _of("{:,}".format, "ticks"),
        "missed": _of(percent, "missed_pct"),
        "the host's own": _of(percent, "host_pct"),
        "beyond it, median": _of(percent, "beyond_host_pct"),
        "by work or link": _of(percent, "by_work_or_link_pct"),
        "trip p50 [µs]": _PERCENTILES["p50"],
        "p99 [µs]": _PERCENTILES["p99"],
    }
    yield _table("The product in real time, 10 kHz", rows, named | shares)
    causes = {cause: _of("{:,}".format, "causes", cause) for row in rows for cause in row["causes"]}
    burst = {"longest burst": _of(_longest, "bursts")}
    yield _table("Missed ticks by cause", rows, named | causes | burst)
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
        columns |= {"who": "name", "ticks": _of("{:,}".format, "count")}
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
        "allocations": _of("{:g}".format, "allocations_per_tick"),
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
    "": "name", "load": "load", "policy": "policy", "wait": "wait",
    "B": _of("{:,}".format, "payload"),
}  # fmt: skip


def sweep_tables(rows: list[Row]) -> Iterator[Table]:
    """Round trips of a sweep with their cost."""
    figures = {
        "kHz": _of("{:g}".format, "khz"),
        "p50": _PERCENTILES["p50"],
        "p99": _PERCENTILES["p99"],
        "missed": _of(percent, "missed_pct"),
        "processors": _of(percent, "processor_pct"),
        "opened, kB": _of("{:,}".format, "opened_kb"),
    }
    heading = "Round trips from the deadline, by payload and rate [µs]"
    yield _table(heading, rows, _SWEPT | figures)


def rate_tables(rows: list[Row]) -> Iterator[Table]:
    """The highest rates of a sweep."""
    most = percent(rows[0]["most_missed_pct"]) if rows else ""
    rate = {"kHz": lambda row: f"{row['highest_khz']:g}" if row["highest_khz"] else "none"}
    yield _table(f"Highest rate at which at most {most} miss", rows, _SWEPT | rate)
