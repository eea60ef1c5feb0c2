"""Figures of a part: the judged signals with windows and limits; and the matrix of all verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gfm_hil.core.files import replacing
from gfm_hil.recording.columns import printed, unit_of
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.results.figures import COLOURS, Picture, draw_panel, headline, panels
from gfm_hil.run.cycles import cycle_means, cycle_ticks
from gfm_hil.studies.conformity.criteria.base import at_connection
from gfm_hil.studies.conformity.criteria.nfp import Nfp
from gfm_hil.studies.conformity.verdict import (
    CANNOT,
    CONSISTENT,
    FAIL,
    INFORMATIVE,
    LIMITED,
    PASS,
    SIGNS,
    Verdict,
)
from gfm_hil.studies.scan import FrequencyScan
from gfm_hil.studies.scan_figures import nfp

#: of Okabe and Ito, and a grey
VERDICT_COLOURS = {
    PASS: COLOURS[2], FAIL: COLOURS[1], CANNOT: "#999999", LIMITED: COLOURS[4],
    CONSISTENT: COLOURS[3], INFORMATIVE: COLOURS[0],
}  # fmt: skip
_ALWAYS = ("p", "V", "i", "f_hz")
_TITLES = {"p": "active power p", "V": "voltage V", "i": "current", "f_hz": "frequency f"}
_LIGHT = "#c9d6e2"


def draw_part(path: Path, title: str, run: Run, verdicts: Sequence[Verdict]) -> Picture:
    """Draw one run: every tick in light grey, one-cycle means in blue, the limits that were judged
    in the colour of their verdict, and at the bottom of each panel the windows without limits."""
    judged = [v.signal for v in verdicts if v.signal and v.signal != "omega_u"]
    names = list(dict.fromkeys([*_ALWAYS, *judged]))
    figure = Figure(figsize=(9.0, 0.6 + 1.45 * len(names)), layout="constrained")
    rows = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    t = np.asarray(run.columns["t"][:])
    T_s = run.scenario.T_s
    width = cycle_ticks(T_s, nominal_frequency(run.scenario))
    for axes, name in zip(rows, names, strict=True):
        x = np.asarray(run.signals[at_connection(run, name)])
        curves = [(t, x, _LIGHT, "every tick")]
        means = np.concatenate([np.empty(0), *cycle_means(x, 0, len(x), width)])
        if len(means):
            middle = (np.arange(len(means)) + 0.5 * (width - 1)) * T_s
            curves.append((middle, means, COLOURS[0], "one-cycle mean"))
        shown, factor = (unit_of(name) or "–"), 1.0
        if shown == "rad":
            shown, factor = "°", 180 / np.pi
        draw_panel(
            axes, f"{_TITLES.get(name, printed(name))} [{shown}]", curves, factor, styles=("-",)
        )
        _limits(axes, [v for v in verdicts if v.signal == name])
        for event in run.summary["events"]:
            axes.axvline(event["t"], color="#888888", lw=0.7, ls=(0, (4, 3)), zorder=0)
    rows[0].legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    rows[-1].set_xlim(0, run.scenario.duration)
    rows[-1].set_xlabel("t [s]", fontsize=9)
    return _finish(figure, path, title)


def draw_plot(
    path: Path, title: str, found: FrequencyScan, asked: Nfp, verdicts: Sequence[Verdict]
) -> Picture:
    """Draw the network-frequency-perturbation plot with the limits of its bands."""
    figure = Figure(figsize=(7.6, 5.6), layout="constrained")
    asked.draw_limits(nfp(found, figure), verdicts, VERDICT_COLOURS)
    return _finish(figure, path, title)


def _finish(figure: Figure, path: Path, title: str) -> Picture:
    headline(figure, title, 10)
    _save(figure, path)
    return Picture(path, panels(figure))


def _limits(axes: Axes, verdicts: Sequence[Verdict]) -> None:
    row = 0
    for v in verdicts:
        colour = VERDICT_COLOURS[v.verdict]
        if v.curve is not None:
            t, low, high = v.curve
            axes.fill_between(t, low, high, color=colour, alpha=0.12, lw=0)
            for edge in (low, high):
                axes.plot(t, edge, color=colour, lw=1.2, ls=(0, (3, 1.5)))
        elif v.limited is not None:
            for limit in (v.low, v.high):
                if limit is not None:
                    axes.plot(v.limited, [limit, limit], color=colour, lw=1.4, ls=(0, (3, 1.5)))
            if v.low is not None and v.high is not None:
                axes.fill_between(v.limited, v.low, v.high, color=colour, alpha=0.12, lw=0)
        elif v.stop > v.start:
            axes.plot(
                [v.start, v.stop], [0.03 + 0.06 * (row % 4)] * 2, color=colour, lw=2.5,
                transform=axes.get_xaxis_transform(), solid_capstyle="butt",
            )  # fmt: skip
            row += 1


def draw_matrix(
    path: Path, laws: Sequence[str], tests: Sequence[str], cells: Mapping[tuple[str, str], str]
) -> None:
    """Draw laws × tests, each cell with the colour and the sign of its verdict."""
    size = 3.0 + 0.3 * len(tests), 3.2 + 0.3 * len(laws)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    for row, law in enumerate(laws):
        for column, test in enumerate(tests):
            verdict = cells.get((law, test))
            if verdict is None:
                continue
            colour = VERDICT_COLOURS[verdict]
            axes.add_patch(Rectangle((column - 0.45, row - 0.45), 0.9, 0.9, color=colour, lw=0))
            axes.text(
                column, row, SIGNS[verdict], ha="center", va="center", color="w", fontsize=9,
                fontfamily="DejaVu Sans",
            )  # fmt: skip
    axes.set_xlim(-0.5, len(tests) - 0.5)
    axes.set_ylim(len(laws) - 0.5, -0.5)
    axes.set_xticks(range(len(tests)), tests, rotation=60, ha="left", fontsize=8)
    axes.set_yticks(range(len(laws)), laws, fontsize=8)
    axes.set_aspect("equal")
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    for verdict, colour in VERDICT_COLOURS.items():
        axes.plot([], [], "s", color=colour, label=f"{SIGNS[verdict]} {verdict}")
    figure.legend(fontsize=8, frameon=False, loc="outside lower left", ncols=3)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
