"""Figures of a result as SVG: percentiles in HdrHistogram's style, misses, lockstep, kernel."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gfm_hil.bench.attribution import CAUSES
from gfm_hil.bench.histogram import dense, lower_ends
from gfm_hil.bench.tables import lockstep_name
from gfm_hil.results.figures import COLOURS, dress

_GREY = "#888888"
_BLUE, _RED, _GREEN, _PINK, _ORANGE, _SKY, _BLACK = COLOURS
_CAUSE_COLOURS = dict(zip(CAUSES, (_BLUE, _ORANGE, _SKY, "#b8b8b8"), strict=True))
_LINK_COLOURS = {"shm": _BLUE, "zmq": _RED, "can": _GREEN, "udp": _GREEN}
_OTHERS = (_PINK, _ORANGE, _SKY)


def figures(content: dict[str, Any]) -> dict[str, bytes]:
    """Every figure that a result has data for: name and SVG."""
    loop = content.get("loop", {})
    made: list[tuple[str, Any, Callable[[Any], Figure]]] = [
        ("latency", [r for r in content["results"] if r["n"]], _latency),
        ("jitter", content.get("jitter"), _jitter),
        ("misses", loop.get("realtime"), _misses),
        ("lockstep", loop.get("lockstep"), _lockstep),
        ("kernel", content.get("kernel"), _kernel),
    ]
    return {name: _svg(draw(data)) for name, data, draw in made if data}


def _svg(figure: Figure) -> bytes:
    out = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "gfmhil"}):  # equal results give equal bytes
        figure.savefig(out, format="svg", metadata={"Date": None})
    return out.getvalue()


def _curve(row: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """1/(1 - q) and the µs that a share q does not exceed, one point per bucket."""
    counts = dense(row["histogram"])
    at = np.flatnonzero(counts)
    share = np.cumsum(counts)[at] / counts.sum()
    ends = lower_ends()
    us = (ends[at] + ends[at + 1]) / 2e3
    beyond = np.maximum(1 - share, 0.5 / counts.sum())  # last point: as if half a time exceeds it
    return 1 / beyond, us


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


def _panels(
    rows: list[dict[str, Any]],
    keys: tuple[str, str],
    draw: Callable[[Axes, dict[str, Any], int], None],
    heading: Callable[[str, str], str],
) -> Figure:
    """One panel for each value of the first key (rows) and of the second (columns)."""
    down, across = ([*dict.fromkeys(r[key] for r in rows)] for key in keys)
    size = (4.9 * max(len(across), 1) + 2.0, 3.1 * len(down) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(down), len(across), squeeze=False, sharex=True, sharey=True)
    nines = int(np.log10(max(r["n"] for r in rows)))
    for i, first in enumerate(down):
        for j, second in enumerate(across):
            some = [r for r in rows if (r[keys[0]], r[keys[1]]) == (first, second)]
            for k, row in enumerate(some):
                draw(grid[i][j], row, k)
            dress(grid[i][j], heading(first, second))
            _percentile_axis(grid[i][j], nines)
            if i + 1 < len(down):
                grid[i][j].set_xlabel("")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8.5, frameon=False)
    return figure


def _latency(rows: list[dict[str, Any]]) -> Figure:
    names = [*dict.fromkeys(r["name"] for r in rows if r["peer"] != "C")]
    seen: dict[str, int] = {}
    shade = {}
    for row in (next(r for r in rows if r["name"] == name) for name in names):
        seen[row["link"]] = seen.get(row["link"], 0) + 1
        shade[row["name"]] = 1.0 - 0.3 * (seen[row["link"]] - 1)
    limits = {r["baseline"]: shade[r["name"]] for r in reversed(rows) if r["peer"] != "C"}

    def draw(axes: Axes, row: dict[str, Any], k: int) -> None:
        colour = _LINK_COLOURS.get(row["link"], _OTHERS[k % len(_OTHERS)])
        limit = row["peer"] == "C"
        axes.plot(
            *_curve(row), color=colour, lw=1.1 if limit else 1.7, ls=(0, (3, 2)) if limit else "-",
            alpha=max((limits if limit else shade).get(row["name"], 1.0), 0.3), label=row["name"],
        )  # fmt: skip

    figure = _panels(rows, ("mode", "load"), draw, lambda mode, load: f"{mode}, {load}")
    figure.supylabel("round trip [µs]", fontsize=9)
    return figure


def _jitter(rows: list[dict[str, Any]]) -> Figure:
    waits = [*dict.fromkeys(r["wait"] for r in rows)]

    def draw(axes: Axes, row: dict[str, Any], k: int) -> None:
        colour = COLOURS[waits.index(row["wait"])]
        axes.plot(*_curve(row), color=colour, lw=1.5, label=row["wait"])
        axes.axhline(row["period_us"], color=_GREY, lw=0.8, ls=(0, (4, 3)))

    figure = _panels(rows, ("policy", "load"), draw, lambda policy, load: f"{policy}, {load}")
    figure.supylabel("later than its deadline [µs]", fontsize=9)
    return figure


def _misses(rows: list[dict[str, Any]]) -> Figure:
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
    for k, row in enumerate(rows):
        if row["bursts"]:
            length, count = np.array(row["bursts"]).T
            right.scatter(
                length, count, s=22, color=_LINK_COLOURS.get(row["link"], _PINK),
                marker="o" if row["load"] == "idle" else "x", label=labels[k],
            )  # fmt: skip
    right.set_xscale("log")
    right.set_yscale("log")
    for axis in (right.xaxis, right.yaxis):
        axis.set_major_formatter(lambda x, _: f"{x:g}")
    right.set_xlabel("ticks in a row that were missed", fontsize=9)
    dress(right, "bursts: how many of each length")
    if right.get_legend_handles_labels()[1]:
        right.legend(fontsize=8, frameon=False, loc="upper right")
    return figure


def _bars(axes: Axes, labels: Sequence[str], values: Sequence[float], texts: Sequence[str]) -> None:
    y = np.arange(len(labels))[::-1]
    axes.barh(y, values, 0.6, color=[_LINK_COLOURS.get(label, _GREY) for label in labels])
    axes.set_yticks(y, labels)
    for at, value, text in zip(y, values, texts, strict=True):
        axes.annotate(
            text, (value, at), (4, 0), textcoords="offset points", va="center", fontsize=8,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0},
        )  # fmt: skip


def _lockstep(rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(8.2, 0.9 + 0.42 * len(rows)), layout="constrained")
    axes = figure.subplots()
    rates = [r["times_real_time"]["median"] for r in rows]
    texts = [
        f"{rate:.3g} × ({r['share_of_plant_alone']['median']:.0%} of the plant alone)"
        for r, rate in zip(rows, rates, strict=True)
    ]
    dress(axes, "closed loop in lockstep, times real time at 10 kHz")
    _bars(axes, [lockstep_name(r) for r in rows], rates, texts)
    axes.axvline(1.0, color=_BLACK, lw=0.9, ls=(0, (4, 3)))
    axes.set_xscale("log")
    axes.set_xlim(min(0.5, min(rates) / 2), max(rates) * 12)
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    return figure


def _kernel(rows: list[dict[str, Any]]) -> Figure:
    rows = [r for r in rows if r["real"] == rows[0]["real"]]
    rows = sorted(rows, key=lambda r: float(r["numba_ns"]["median"]))
    figure = Figure(figsize=(8.2, 1.0 + 0.19 * len(rows)), layout="constrained")
    axes = figure.subplots()
    y = np.arange(len(rows))
    dress(axes, f"one step of the kernel [ns], {rows[0]['real']}")
    axes.scatter([r["numba_ns"]["median"] for r in rows], y, s=26, color=_BLUE, label="numba")
    if rows[0]["c_ns"]:
        limits = [r["c_ns"]["median"] for r in rows]
        axes.scatter(limits, y, s=60, marker="|", color=_BLACK, label="C, -O3")
    axes.set_yticks(y, [r["law"] for r in rows])
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xlim(left=0)
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    return figure
