"""Figures of a run and of several side by side, like the paper's: one quantity a panel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gfm_hil.scenario import Scenario
from gfm_hil.summary import nominal_frequency

Signals = dict[str, NDArray[Any]]

# Okabe and Ito's colours: told apart by everyone, and in print
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_POINTS = 4000  # drawn a curve; each pixel column keeps its least and its largest value
_GREY = "#888888"


def _thin(t: NDArray[Any], x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Least and largest value of each stretch, so that no oscillation is drawn away."""
    stretch = len(t) // (_POINTS // 2)
    if stretch < 3:
        return t, x
    n = len(t) // stretch * stretch
    blocks = x[:n].reshape(-1, stretch)
    low, high = np.fmin.reduce(blocks, axis=1), np.fmax.reduce(blocks, axis=1)  # past any NaN
    times = t[:n].reshape(-1, stretch)
    pairs = np.column_stack([low, high]).ravel()
    moments = np.column_stack([times[:, 0], times[:, stretch // 2]]).ravel()
    return np.append(moments, t[n:]), np.append(pairs, x[n:])


def draw_panel(
    axes: Axes, title: str, curves: Sequence[tuple[NDArray[Any], NDArray[Any], str, str]]
) -> None:
    """One quantity: curves of t [s], values, colour and label."""
    for t, x, colour, label in curves:
        axes.plot(*_thin(t, x), color=colour, lw=1.1, label=label)
    axes.set_title(title, loc="left", fontsize=9.5, color="#222222")
    axes.grid(True, color="#e4e4e4", lw=0.6)
    axes.tick_params(labelsize=8.5, color=_GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(_GREY)
    axes.ticklabel_format(useOffset=False)
    low, high = axes.get_ylim()
    least = 1e-3 * max(abs(low), abs(high), 1e-3)  # a flat line is not blown up to noise
    if high - low < least:
        axes.set_ylim((low + high - least) / 2, (low + high + least) / 2)


def _mark(axes: Sequence[Axes], events: Sequence[dict[str, Any]]) -> None:
    for k, event in enumerate(events):
        for a in axes:
            a.axvline(event["t"], color=_GREY, lw=0.8, ls=(0, (4, 3)), zorder=0)
        axes[0].annotate(
            event["label"], (event["t"], 1.0), (3, 20 + 10 * (k % 3)),
            xycoords=("data", "axes fraction"), textcoords="offset points", fontsize=8,
            color="#444444",
        )  # fmt: skip


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for a in axes[-1]:
        a.set_xlabel("t [s]", fontsize=9)
    return figure, list(axes.ravel())


def draw_run(
    folder: Path,
    scenario: Scenario,
    signals: Signals,
    timing: Signals,
    summary: dict[str, Any],
    laws: Sequence[str],
) -> list[Path]:
    """Draw one run into its folder: signals.png and, in real time, timing.png."""
    pictures = []
    if "true_p" in signals:
        pictures.append(_draw_signals(folder, scenario, signals, summary, laws))
    if summary["mode"] == "realtime" and summary["round_trip_us"]:
        pictures.append(draw_timing(folder, scenario, timing, summary))
    return pictures


def _draw_signals(
    folder: Path,
    scenario: Scenario,
    signals: Signals,
    summary: dict[str, Any],
    laws: Sequence[str],
) -> Path:
    figure, axes = _figure(3, 2, (10.5, 7.4))
    t, f_n = signals["t"], nominal_frequency(scenario)
    blue, red, green, *_ = COLOURS

    def panel(axes: Axes, title: str, *names: tuple[str, str, str], factor: float = 1.0) -> None:
        drawn = [(t, signals[n] * factor, c, label) for n, c, label in names if n in signals]
        draw_panel(axes, title, drawn)
        if len(drawn) > 1:
            axes.legend(fontsize=8, frameon=False, loc="best")

    panel(axes[0], "active power p [p.u.]", ("true_p", blue, "p"), ("ref_P_ref", _GREY, "P_ref"))
    panel(axes[1], "reactive power q [p.u.]", ("true_q", blue, "q"), ("ref_Q_ref", _GREY, "Q_ref"))
    panel(
        axes[2], "frequency [Hz]", ("true_omega_u", blue, "converter"),
        ("true_omega_g", _GREY, "grid"), factor=f_n,
    )  # fmt: skip
    panel(axes[3], "voltage V [p.u.]", ("true_V", blue, "V"), ("u_E_u", red, "E_u"))
    panel(axes[4], "DC voltage v_dc [p.u.]", ("true_v_dc", blue, "v_dc"))
    panel(axes[5], "currents [p.u.]", ("true_i", blue, "|i_dq|"), ("u_i_u", green, "i_u"))
    _mark([axes[0], *axes[1:]], summary["events"])
    figure.suptitle(
        f"{scenario.title} — {' → '.join(summary['laws'])}", fontsize=11, x=0.01,
        ha="left",
    )  # fmt: skip
    path = folder / "signals.png"
    figure.savefig(path, dpi=110)
    return path


def draw_timing(folder: Path, scenario: Scenario, timing: Signals, summary: dict[str, Any]) -> Path:
    """Draw into timing.png how long round trips took and when a fresh u was missing."""
    figure = Figure(figsize=(10.5, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    there = timing["plant_received"] >= 0
    us = (timing["plant_received"] - timing["plant_sent"])[there] / 1e3
    late = (timing["plant_woke"] - timing["plant_scheduled"])[timing["plant_woke"] >= 0] / 1e3
    for x, colour, label in (
        (us, COLOURS[0], "y[k] sent → u[k] received"),
        (late, COLOURS[1], "tick begun after its deadline"),
    ):
        ordered = np.sort(x)
        beyond = 1 - np.arange(len(x)) / len(x)
        left.loglog(np.maximum(ordered, 0.1), beyond, color=colour, lw=1.2, label=label)
    left.axvline(scenario.T_s * 1e6, color=_GREY, lw=0.8, ls=(0, (4, 3)))
    left.set_title("share of ticks beyond a latency [µs]", loc="left", fontsize=9.5)
    left.legend(fontsize=8, frameon=False)
    missed = np.flatnonzero(~there) * scenario.T_s
    right.hist(missed, bins=60, range=(0, summary["duration_s"]), color=COLOURS[1])
    right.set_title(
        f"ticks without a fresh u: {summary['misses']} of {summary['ticks']}",
        loc="left",
        fontsize=9.5,
    )
    right.set_xlabel("t [s]", fontsize=9)
    for a in (left, right):
        a.grid(True, color="#e4e4e4", lw=0.6)
        a.tick_params(labelsize=8.5)
    path = folder / "timing.png"
    figure.savefig(path, dpi=110)
    return path


def draw_comparison(
    path: Path, scenario: Scenario, runs: dict[str, Signals], events: Sequence[dict[str, Any]]
) -> None:
    """p, frequency, q and v_dc of several laws in one figure, like the paper's."""
    figure, axes = _figure(4, 1, (8.6, 8.2))
    f_n = nominal_frequency(scenario)
    for a, (title, name, factor) in zip(
        axes,
        (
            ("active power p [p.u.]", "true_p", 1.0),
            ("frequency [Hz]", "true_omega_u", f_n),
            ("reactive power q [p.u.]", "true_q", 1.0),
            ("DC voltage v_dc [p.u.]", "true_v_dc", 1.0),
        ),
        strict=True,
    ):
        curves = [
            (s["t"], s[name] * factor, COLOURS[k % len(COLOURS)], law)
            for k, (law, s) in enumerate(runs.items())
        ]
        draw_panel(a, title, curves)
    axes[0].legend(fontsize=8.5, frameon=False, ncols=min(4, len(runs)), loc="lower right")
    _mark(axes, events)
    figure.suptitle(scenario.title, fontsize=11, x=0.01, ha="left")
    figure.savefig(path, dpi=110)
