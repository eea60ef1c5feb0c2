"""Figures of the league: gamma by law, gamma against the delay it stands, steps of the best."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gfm_hil.figures import COLOURS
from gfm_hil.league_bench import AT, TRACE_EVERY
from gfm_hil.league_tables import worst

Row = dict[str, Any]

_T_S = 1e-4  # s
_BEST = 5
_CHANNELS = ("W_11", "W_21", "W_22", "W_31", "W_32", "W_41")


def draw(folder: Path, rows: Sequence[Row]) -> None:
    """All figures of the laws that have a gamma; none without any."""
    rated = [row for row in rows if row["gamma"] is not None]
    if rated:
        _gammas(folder / "league_gamma.png", rated)
        _delays(folder / "league_delay.png", rated)
        _steps(folder / "league_steps.png", rated[:_BEST])


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.grid(True, color="#e4e4e4", lw=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _channel(row: Row) -> str:
    c = worst(row)
    return f"W_{c['i']}{c['j']}"


def _gammas(path: Path, rows: Sequence[Row]) -> None:
    """Tuned gamma as bars, coloured by the worst channel; own gains as marks."""
    figure, axes = _figure(7.5, 1.2 + 0.25 * len(rows))
    place = np.arange(len(rows))
    for channel, colour in zip(_CHANNELS, COLOURS, strict=False):
        mine = [k for k, row in enumerate(rows) if _channel(row) == channel]
        if mine:
            gammas = [rows[k]["gamma"] for k in mine]
            axes.barh(place[mine], gammas, color=colour, label=f"tuned; {channel} is worst")
    own = [(k, row["before"]["gamma"]) for k, row in enumerate(rows) if row["before"]["gamma"]]
    if own:
        axes.plot(*[[o[1] for o in own], [o[0] for o in own]], "k|", ms=9, label="own gains")
    axes.set_yticks(place, [row["law"] for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="γ of the paper's problem", xlim=(1.0, None))
    axes.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.25))
    figure.savefig(path, dpi=110)


def _delays(path: Path, rows: Sequence[Row]) -> None:
    """gamma against the delay that the sampled loop stands."""
    figure, axes = _figure(7.0, 4.6)
    shown = [row for row in rows if row["delay_us"] is not None]
    for row in shown:
        x, y = row["delay_us"], row["gamma"]
        colour = COLOURS[_CHANNELS.index(_channel(row))]
        axes.plot(x, y, "o", color=colour, ms=5)
        axes.annotate(row["law"], (x, y), fontsize=6.5, xytext=(4, 2), textcoords="offset points")
    axes.axvline(1e6 * _T_S, color="k", ls="--", lw=1)
    axes.text(1e6 * _T_S, axes.get_ylim()[1], " one sample", fontsize=8, va="top")
    axes.set(xscale="log", yscale="log")
    axes.set(xlabel="delay from sample to action that the loop stands [µs]", ylabel="γ, tuned")
    figure.savefig(path, dpi=110)


def _steps(path: Path, rows: Sequence[Row]) -> None:
    """p after the step of P_ref on the nonlinear bench."""
    figure, axes = _figure(7.0, 3.6)
    for row, colour in zip(rows, COLOURS, strict=False):
        p = np.array(row["bench"]["p_ref"]["trace"])
        t = np.arange(len(p)) * TRACE_EVERY * _T_S - AT
        axes.plot(t, p, color=colour, lw=1.2, label=f"{row['law']}, γ = {row['gamma']:.3g}")
    axes.set(xlabel="time after the step [s]", ylabel="p [p.u.]", xlim=(-0.1, 2.0))
    axes.legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=110)
