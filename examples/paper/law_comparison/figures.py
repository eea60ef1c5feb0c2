"""Figures of the law comparison: γ by law, overshoot on the bench over γ, steps of some laws."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from gfm_design.model.closed_loop import T_S
from gfm_hil.results.figures import COLOURS, dress
from law_comparison.experiments import AT, TRACE_EVERY
from law_comparison.tables import others, worst

Row = dict[str, Any]

_CURVES, _APART = 5, 1.25  # steps that are drawn; least ratio of their gammas
_TOP = 100.0  # %; what overshoots more is drawn there
_PER_DECADE, _CELL = 5, 12.0  # size of a label's neighbourhood: decades of gamma, per cent
_CHANNELS = ("W_11", "W_21", "W_22", "W_31", "W_32", "W_41")


def draw(folder: Path, rows: Sequence[Row]) -> None:
    """All figures of the laws that have a gamma; none without any."""
    rated = [row for row in rows if row["gamma"] is not None]
    if rated:
        _gammas(folder / "law_comparison_gamma.png", rated)
        _overshoots(folder / "law_comparison_overshoot.png", rated)
        _steps(folder / "law_comparison_steps.png", _spread(rated))


def _spread(rows: Sequence[Row]) -> list[Row]:
    """The first few rows whose gammas differ by a factor: the best of each kind."""
    chosen = [rows[0]]
    for row in rows[1:]:
        if row["gamma"] > _APART * chosen[-1]["gamma"] and len(chosen) < _CURVES:
            chosen.append(row)
    return chosen


def _figure(width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    dress(axes)
    return figure, axes


def _channel(row: Row) -> str:
    c = worst(row)
    return f"W_{c['i']}{c['j']}"


def _gammas(path: Path, rows: Sequence[Row]) -> None:
    """gamma as bars, coloured by the worst channel; own gains and the other channels as marks."""
    figure, axes = _figure(7.5, 1.5 + 0.25 * len(rows))
    place = np.arange(len(rows))
    for channel, colour in zip(_CHANNELS, COLOURS, strict=False):
        mine = [k for k, row in enumerate(rows) if _channel(row) == channel]
        if mine:
            gammas = [rows[k]["gamma"] for k in mine]
            axes.barh(place[mine], gammas, color=colour, label=f"tuned; {channel} is worst")
    own = [(row["before"]["gamma"], k) for k, row in enumerate(rows) if row["before"]["gamma"]]
    if own:
        axes.plot(*zip(*own, strict=True), "k|", ms=9, label="own gains")
    rest = [(others(row), k) for k, row in enumerate(rows) if row["fixed"]]
    if rest:
        label = "tuned; channels that are not pinned"
        axes.plot(*zip(*rest, strict=True), "kD", mfc="w", ms=5, label=label)
    axes.set_yticks(place, [row["law"] for row in rows], fontsize=8)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="γ of the paper's problem", xlim=(1.0, None))
    axes.margins(y=0.01)
    figure.legend(fontsize=8, loc="outside upper center", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)


def _overshoots(path: Path, rows: Sequence[Row]) -> None:
    """What the bench shows over what the linear problem says; laws close together share a label."""
    figure, axes = _figure(7.5, 4.4)
    together: dict[tuple[int, int], list[tuple[float, float, str]]] = {}
    for row in rows:
        overshoot = row["bench"]["p_ref"].get("overshoot_pct")
        if overshoot is not None:
            x, colour = others(row), COLOURS[_CHANNELS.index(_channel(row))]
            y, beyond = min(overshoot, _TOP), overshoot > _TOP
            axes.plot(x, y, "^" if beyond else "o", color=colour, ms=5)
            cell = round(_PER_DECADE * np.log10(x)), round(y / _CELL)
            name = f"{row['law']} ({overshoot:.0f} %)" if beyond else row["law"]
            together.setdefault(cell, []).append((x, y, name))
    for points in together.values():
        x, y, _ = max(points)
        names = [name for _, _, name in points]
        lines = [", ".join(names[k : k + 3]) for k in range(0, len(names), 3)]
        axes.annotate(
            "\n".join(lines), (x, y), fontsize=7, xytext=(5, 0), va="center",
            textcoords="offset points",
        )  # fmt: skip
    axes.set(xscale="log", xlabel="γ of the channels that are not pinned")
    axes.set(ylabel="overshoot of p, P_ref 0.5 to 1 p.u. [%]")
    figure.savefig(path, dpi=110)


def _steps(path: Path, rows: Sequence[Row]) -> None:
    """p after the step of P_ref on the nonlinear bench."""
    figure, axes = _figure(7.0, 3.6)
    for row, colour in zip(rows, COLOURS, strict=False):
        p = np.array(row["bench"]["p_ref"]["trace"])
        t = np.arange(len(p)) * TRACE_EVERY * T_S - AT
        axes.plot(t, p, color=colour, lw=1.2, label=f"{row['law']}, γ = {row['gamma']:.3g}")
    axes.set(xlabel="time after the step [s]", ylabel="p [p.u.]", xlim=(-0.1, 2.0))
    axes.legend(fontsize=8, loc="lower right")
    figure.savefig(path, dpi=110)
