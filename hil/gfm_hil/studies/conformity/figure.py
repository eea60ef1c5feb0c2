"""The picture of a part, and that of the matrix of all verdicts."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gfm_hil.core.files import replacing
from gfm_hil.results.curves import Panel
from gfm_hil.results.figures import COLOURS, dress, headline
from gfm_hil.studies.conformity.panels import VERDICT_COLOURS, Mark
from gfm_hil.studies.conformity.verdict import SIGNS

_LIGHT = "#c9d6e2"
_LEAST, _LINE = 1.45, 0.125  # inches: height of a panel, and of a line of text beside it


def draw_panels(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Draw the panels of one run below each other: the first curve in light grey, the second in
    blue, limits and windows in the colour of their verdict, and beside each panel the number,
    limit and window of each clause."""
    heights = [max(_LEAST, 0.3 + _LINE * len(panel.marks)) for panel in panels]
    figure = Figure(figsize=(8.8, 0.6 + sum(heights)), layout="constrained")
    rows = figure.subplots(
        len(panels), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": heights}
    )[:, 0]
    for axes, panel in zip(rows, panels, strict=True):
        dots = panel.log[0]
        for (label, y), colour in zip(panel.curves.items(), (_LIGHT, COLOURS[0]), strict=False):
            style = "o" if dots and label == "measured" else "-"
            axes.plot(panel.x, y, style, color=colour, lw=1.1, ms=3.5, label=label)
        dress(axes, panel.title)
        axes.set_xscale("log" if panel.log[0] else "linear")
        axes.set_yscale("log" if panel.log[1] else "linear")
        if not panel.log[1]:
            axes.ticklabel_format(axis="y", useOffset=False)
        for k, mark in enumerate(panel.marks):
            _draw_mark(axes, mark, k)
        for t, _ in panel.events:
            axes.axvline(t, color="#888888", lw=0.7, ls=(0, (4, 3)), zorder=0)
        low, high = axes.get_ylim()
        least = 1e-3 * max(abs(low), abs(high), 1e-3)  # a flat line is not blown up to noise
        if high - low < least:
            axes.set_ylim((low + high - least) / 2, (low + high + least) / 2)
    rows[0].legend(fontsize=8, frameon=False, loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    rows[-1].set_xlim(*panels[-1].ends)
    rows[-1].set_xlabel(panels[-1].over, fontsize=9)
    headline(figure, title, 10)
    _save(figure, path)


def _draw_mark(axes: Axes, mark: Mark, row: int) -> None:
    colour = mark.colour
    axes.annotate(
        f"{mark.number} {SIGNS.get(mark.verdict, '•')} {mark.words}", (1.0, 1.0),
        (6, -9 * row), xycoords="axes fraction", textcoords="offset points", va="top",
        fontsize=7, color=colour, fontfamily="DejaVu Sans",
    )  # fmt: skip
    for x, y in mark.lines:
        axes.plot(x, y, color=colour, lw=1.4, ls=(0, (3, 1.5)))
    if len(mark.lines) == 2:
        (x, low), (_, high) = mark.lines
        axes.fill_between(x, low, high, color=colour, alpha=0.12, lw=0)
    if mark.lines:
        x, y = mark.lines[-1]
        axes.annotate(
            str(mark.number), (x[0], y[0]), (1, 1), textcoords="offset points", fontsize=7,
            color=colour, annotation_clip=True,
        )  # fmt: skip
    elif mark.window[1] > mark.window[0]:
        axes.plot(
            mark.window, [0.03 + 0.06 * (row % 4)] * 2, color=colour, lw=2.5,
            transform=axes.get_xaxis_transform(), solid_capstyle="butt",
        )  # fmt: skip


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
    _save(figure, path, "tight")  # the layout does not see how long a slanted name is


def _save(figure: Figure, path: Path, box: str | None = None) -> None:
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png", bbox_inches=box)
