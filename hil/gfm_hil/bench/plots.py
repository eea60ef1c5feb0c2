"""Figures of a result: percentiles in HdrHistogram's style, misses, lockstep, kernel."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter
from numpy.typing import NDArray

from gfm_hil.bench.histogram import bars, lower_ends
from gfm_hil.bench.night import PER_ROW
from gfm_hil.bench.tables import lockstep_name, micro
from gfm_hil.links import link_names
from gfm_hil.results.figures import COLOURS, GREY, dress
from gfm_hil.run.attribution import CAUSES

_BLUE, _, _, _, _ORANGE, _SKY, _BLACK = COLOURS
_CAUSE_COLOURS = dict(zip(CAUSES, (_BLUE, _ORANGE, _SKY, "#b8b8b8"), strict=True))

Row = dict[str, Any]


def _colours(names: list[str]) -> dict[str, str]:
    """The colour of each link, the same in every figure, and then of each other name."""
    every = dict.fromkeys([*link_names(), *names])
    return {name: COLOURS[k % (len(COLOURS) - 1)] for k, name in enumerate(every)}


def _curve(row: Row) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """1/(1 - q) and the µs that a share q does not exceed, one point per bucket."""
    middles, counts = bars(row["histogram"])
    share = np.cumsum(counts) / counts.sum()
    beyond = np.maximum(1 - share, 0.5 / counts.sum())  # last point: as if half a time exceeds it
    return 1 / beyond, middles / 1e3


def _percentile_axis(axes: Axes, nines: int) -> None:
    marks = [2.0] + [10.0**k for k in range(1, nines + 1)]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(1.0, 2 * 10.0**nines)
    shares = [f"{100 * (1 - 1 / m):.{max(0, k - 2)}f} %" for k, m in enumerate(marks)]
    axes.set_xticks(marks, shares)
    axes.minorticks_off()
    axes.yaxis.set_major_formatter(lambda x, _: f"{x:,g}" if x < 1e4 else f"{x:,.0f}")
    axes.set_xlabel("share of all that take no longer", fontsize=9)


def _panels(rows: list[Row], keys: list[str], label: str, draw: Callable[..., None]) -> Figure:
    """One panel for each value of the first key (rows) and of the second (columns)."""
    down, across = ([*dict.fromkeys(r[key] for r in rows)] for key in keys)
    size = (4.9 * len(across) + 2.0, 3.1 * len(down) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(down), len(across), squeeze=False, sharex=True, sharey=True)
    nines = int(np.log10(max(r["n"] for r in rows)))
    for i, first in enumerate(down):
        for j, second in enumerate(across):
            for row in rows:
                if (row[keys[0]], row[keys[1]]) == (first, second):
                    draw(grid[i][j], row)
            dress(grid[i][j], f"{first}, {second}")
            _percentile_axis(grid[i][j], nines)
            if i + 1 < len(down):
                grid[i][j].set_xlabel("")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8.5, frameon=False)
    figure.supylabel(label, fontsize=9)
    return figure


def latency(rows: list[Row]) -> Figure | None:
    """Percentiles of the round trips: a link's contenders in shades of one colour, limits dashed
    in the colour of the first contender that is compared with them."""
    rows = [r for r in rows if r["n"]]
    contenders = list({r["name"]: r for r in rows if r["peer"] != "C"}.values())
    colours = _colours([r["link"] for r in contenders])
    look = dict[str, tuple[str, float]]()
    for k, row in enumerate(contenders):
        same = sum(other["link"] == row["link"] for other in contenders[:k])
        look[row["name"]] = colours[row["link"]], max(1.0 - 0.3 * same, 0.3)
    limits = {r["baseline"]: look[r["name"]] for r in reversed(contenders)}

    def draw(axes: Axes, row: Row) -> None:
        limit = row["peer"] == "C"
        colour, alpha = (limits if limit else look).get(row["name"], (GREY, 1.0))
        axes.plot(
            *_curve(row), color=colour, alpha=alpha, label=row["name"],
            lw=1.1 if limit else 1.7, ls=(0, (3, 2)) if limit else "-",
        )  # fmt: skip

    return _panels(rows, ["mode", "load"], "round trip [µs]", draw) if rows else None


def night(rows: list[Row]) -> Figure | None:
    """How often each time was measured in the course of a night, a panel for each cell."""
    rows = [row for row in rows if "night" in row and row["n"]]
    if not rows:
        return None
    figure = Figure(figsize=(9.2, 0.5 + 1.9 * len(rows)), layout="constrained")
    ends = lower_ends()[::PER_ROW] / 1e3
    for axes, row in zip(figure.subplots(len(rows), squeeze=False)[:, 0], rows, strict=True):
        heat = row["night"]["heat"]
        hours = np.subtract(heat["at"], heat["at"][0]) / 3600
        last = hours[-1] - hours[-2] if len(hours) > 1 else 1 / 360
        hours = np.append(hours, hours[-1] + last)
        counts = np.zeros((len(ends) - 1, len(heat["counts"])))
        for column, pairs in enumerate(heat["counts"]):
            for k, n in pairs:
                counts[k, column] = n
        shares = counts / counts.sum(axis=0)
        seen = np.flatnonzero(counts.sum(axis=1))
        drawn = axes.pcolormesh(
            hours, np.maximum(ends, 1e-3), np.where(shares > 0, shares, np.nan),
            norm=LogNorm(1e-7, 1.0), cmap="viridis", rasterized=True,
        )  # fmt: skip
        axes.set_yscale("log")
        axes.set_ylim(ends[seen[0]] or 0.01, 1.3 * ends[seen[-1] + 1])
        axes.yaxis.set_major_formatter(lambda x, _: f"{x:g}")
        axes.yaxis.set_minor_formatter(lambda x, _: "")
        dress(axes, f"{row['name']}, {row['mode']}, {row['load']}: round trip [µs]")
        figure.colorbar(drawn, ax=axes, label="share")
    axes.set_xlabel("hours since the start", fontsize=9)
    return figure


def jitter(rows: list[Row]) -> Figure:
    """Percentiles of the lateness, and the period."""
    colours = dict(zip(dict.fromkeys(r["wait"] for r in rows), COLOURS, strict=False))

    def draw(axes: Axes, row: Row) -> None:
        axes.plot(*_curve(row), color=colours[row["wait"]], lw=1.5, label=row["wait"])
        axes.axhline(row["period_us"], color=GREY, lw=0.8, ls=(0, (4, 3)))

    return _panels(rows, ["policy", "load"], "later than its deadline [µs]", draw)


def misses(rows: list[Row]) -> Figure:
    """Missed ticks by cause, with those of the host alone, and their bursts."""
    figure = Figure(figsize=(11.8, 1.6 + 0.42 * len(rows)), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    labels = [f"{r['link']}, {r['load']}" for r in rows]
    y = np.arange(len(rows))[::-1]
    begin = np.zeros(len(rows))
    for cause in CAUSES:
        width = np.array([100 * r["causes"].get(cause, 0) / max(r["ticks"], 1) for r in rows])
        left.barh(y, width, 0.6, begin, color=_CAUSE_COLOURS[cause], label=cause)
        begin += width
    host = [r["host_pct"] for r in rows]
    left.scatter(host, y, marker="|", s=260, color=_BLACK, label="a loop that only paces")
    left.set_yticks(y, labels)
    left.set_xlim(left=0)
    dress(left, "ticks without a fresh u [%], by cause")
    left.legend(fontsize=8, frameon=False, loc="best")
    colours = _colours([r["link"] for r in rows])
    for label, row in zip(labels, rows, strict=True):
        if row["bursts"]:
            length, count = np.array(row["bursts"]).T
            marker = "o" if row["load"] == "idle" else "x"
            colour = colours[row["link"]]
            right.scatter(length, count, s=22, color=colour, marker=marker, label=label)
    right.set_xscale("log")
    right.set_yscale("log")
    for axis in (right.xaxis, right.yaxis):
        axis.set_major_formatter(lambda x, _: f"{x:g}")
        axis.set_minor_formatter(LogFormatter())  # as numbers, and only within a decade
    right.set_xlabel("ticks in a row that were missed", fontsize=9)
    dress(right, "bursts: how many of each length")
    if right.get_legend_handles_labels()[1]:
        right.legend(fontsize=8, frameon=False, loc="upper right")
    return figure


def lockstep(rows: list[Row]) -> Figure:
    """Times real time over each link."""
    figure = Figure(figsize=(8.2, 0.9 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    dress(axes, "closed loop in lockstep, times real time at 10 kHz")
    colours = _colours([])
    rates = [r["times_real_time"]["median"] for r in rows]
    y = np.arange(len(rows))[::-1]
    drawn = axes.barh(y, rates, 0.6, color=[colours.get(r["link"], GREY) for r in rows])
    axes.set_yticks(y, [lockstep_name(r) for r in rows])
    shares = [r["share_of_plant_alone"]["median"] for r in rows]
    texts = [
        f"{rate:.3g} × ({share:.0%} of the plant alone)"
        for rate, share in zip(rates, shares, strict=True)
    ]
    white = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
    axes.bar_label(drawn, texts, padding=4, fontsize=8, bbox=white)
    axes.axvline(1.0, color=_BLACK, lw=0.9, ls=(0, (4, 3)))
    axes.set_xscale("log")
    axes.set_xlim(min(0.5, min(rates) / 2), max(rates) * 12)
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    return figure


def kernel(rows: list[Row]) -> Figure:
    """ns per step of every law, in the first real type."""
    real = rows[0]["real"]
    rows = sorted((r for r in rows if r["real"] == real), key=lambda r: r["numba_ns"]["median"])
    figure = Figure(figsize=(8.2, 1.0 + 0.19 * len(rows)), layout="constrained")
    axes, y = figure.subplots(), np.arange(len(rows))
    dress(axes, f"one step of the kernel [ns], {real}")
    axes.scatter([r["numba_ns"]["median"] for r in rows], y, s=26, color=_BLUE, label="numba")
    if rows[0]["c_ns"]:
        limits = [r["c_ns"]["median"] for r in rows]
        axes.scatter(limits, y, s=60, marker="|", color=_BLACK, label="C, -O3")
    axes.set_yticks(y, [r["law"] for r in rows])
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xlim(left=0)
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    return figure


_LOW_PCT, _HIGH_PCT = 0.01, 100.0  # limits of the colours of a heat map


def sweep(rows: list[Row]) -> Figure:
    """Share of missed messages by payload and rate: one heat map per contender and condition, with
    p99 in each field."""
    keys = ("name", "load", "policy", "wait")
    maps = [*dict.fromkeys(tuple(r[key] for key in keys) for r in rows)]
    payloads, rates = (sorted({r[key] for r in rows}) for key in ("payload", "khz"))
    across = min(4, len(maps))
    down = -(-len(maps) // across)
    size = (0.9 + (0.8 + 0.62 * len(rates)) * across + 0.9, (1.1 + 0.42 * len(payloads)) * down)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    for axes, which in zip(grid.flat, maps, strict=False):
        missed = np.full((len(payloads), len(rates)), np.nan)
        for r in rows:
            if tuple(r[key] for key in keys) == which and r["missed_pct"] is not None:
                i, j = payloads.index(r["payload"]), rates.index(r["khz"])
                missed[i, j] = max(r["missed_pct"], _LOW_PCT)
                look = {"fontsize": 7, "color": "white" if missed[i, j] > 1.0 else "black"}
                axes.text(j, i, micro(r["p99_us"]), ha="center", va="center", **look)
        colours = LogNorm(_LOW_PCT, _HIGH_PCT)
        image = axes.imshow(missed, cmap="viridis_r", norm=colours, aspect="auto", origin="lower")
        axes.set_xticks(range(len(rates)), [f"{rate:g}" for rate in rates])
        axes.set_yticks(range(len(payloads)), [f"{size:,}" for size in payloads])
        axes.set_title(", ".join(which), fontsize=7.5)
    for axes in grid.flat[len(maps) :]:
        axes.axis("off")
    figure.colorbar(image, ax=grid, label="missed [%]", fraction=0.03)
    figure.supxlabel("rate [kHz]; in each field p99 [µs]", fontsize=9)
    figure.supylabel("payload [B]", fontsize=9)
    return figure
