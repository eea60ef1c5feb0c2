"""How a figure for a person is drawn: on a screen or for a paper, in axes of their own, saved.

Sizes and colours are ours where matplotlib's ``rcParams`` have their defaults; one that is set,
by a style sheet or by hand, counts.
"""

from __future__ import annotations

import csv
import functools
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import replacing
from gfm_runtime.errors import allowed

if TYPE_CHECKING:  # matplotlib takes half a second to import: the functions that draw import it
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers can tell apart, and which print well
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
STYLES = ("screen", "paper")
COLUMN = 3.5  # inches, the width of a column of IEEE's journals
_ROW = 1.15  # inches, the height of a panel in a column
#: of a paper: no text below 7 points, fonts embedded as IEEE asks for
_PAPER: dict[str, Any] = {
    "font.size": 8.0, "axes.titlesize": 8.0, "axes.labelsize": 8.0, "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0, "legend.fontsize": 7.0, "figure.titlesize": 8.0,
    "lines.linewidth": 1.0, "axes.linewidth": 0.6, "pdf.fonttype": 42, "savefig.dpi": 600.0,
}  # fmt: skip
FORMATS = ("pdf", "svg", "pgf", "csv", "png")


@dataclass(frozen=True)
class Look:
    """What the caller of a plot asks for."""

    ax: tuple[Axes, ...] = ()  # to draw in; none for a new figure
    xlim: tuple[float, float] | None = None
    size: tuple[float, float] | None = None  # of a new figure, inches
    paper: bool = False

    def figure_size(self, size: tuple[float, float], rows: int) -> tuple[float, float]:
        """That of a new figure, which has ``size`` on a screen."""
        ours = (COLUMN, _ROW * rows + 0.55) if self.paper else size
        return self.size or tuple(rc("figure.figsize", ours))


_PLAIN = Look()
_LOOK = ContextVar[Look]("look")


def look() -> Look:
    """That of the plot that is being drawn."""
    return _LOOK.get(_PLAIN)


def rc(name: str, ours: Any) -> Any:
    """A value of ``rcParams`` if someone has set it, else ours."""
    from matplotlib import rcParams, rcParamsDefault

    both: Any = rcParams, rcParamsDefault  # whose keys are a type of their own
    theirs, defaults = both
    return theirs[name] if theirs[name] != defaults[name] else ours


def own_colour(ours: str) -> str:
    """One of ``COLOURS``, or that of the same number in a cycle of colours someone has set."""
    cycle = rc("axes.prop_cycle", None)
    if cycle is None or ours not in COLOURS or "color" not in cycle.keys:
        return ours
    theirs = cycle.by_key()["color"]
    return str(theirs[COLOURS.index(ours) % len(theirs)])


_OPTIONS = """\
Every plot also takes ``ax``: axes to draw in, as many as there are panels; ``xlim``: from where to
where the abscissa goes, in its unit; ``size``: width and height of a new figure, inches; and
``style``: ``screen``, or ``paper``, 3.5 inches wide, panels below each other, symbols at the axes.
``UserError``: one of them is none of these."""


def with_look(draw: Callable[..., Any]) -> Callable[..., Any]:
    """Give a plot the options of every plot, and the words on them to its docstring."""

    @functools.wraps(draw)
    def drawn(
        *args: Any,
        ax: Axes | Sequence[Axes] | None = None,
        xlim: tuple[float, float] | None = None,
        size: tuple[float, float] | None = None,
        style: str = STYLES[0],
        **more: Any,
    ) -> Any:
        from matplotlib import rc_context

        if style not in STYLES:
            raise UserError(f"style = {style!r}: {allowed(style, STYLES)}")
        theirs = () if ax is None else tuple(np.ravel(np.asarray(ax, dtype=object)))
        if not all(hasattr(one, "plot") for one in theirs):
            raise UserError(f"ax = {ax!r}: must be axes of matplotlib")
        asked = Look(
            theirs, _pair("xlim", xlim, "from < to", lambda a, b: a < b),
            _pair("size", size, "width and height in inches, above 0", lambda a, b: min(a, b) > 0),
            style == "paper",
        )  # fmt: skip
        paper: Any = {name: rc(name, value) for name, value in _PAPER.items() if asked.paper}
        token = _LOOK.set(asked)
        try:
            with rc_context(paper):
                found = draw(*args, **more)
        finally:
            _LOOK.reset(token)
        if asked.xlim is not None:
            for axes in found if isinstance(found, list) else [found]:
                axes.set_xlim(asked.xlim)
        return found

    drawn.__doc__ = f"{inspect.cleandoc(draw.__doc__ or '')}\n\n{_OPTIONS}"
    return drawn


def _pair(
    name: str, value: Any, must: str, fits: Callable[[float, float], bool]
) -> tuple[float, float] | None:
    """Two finite numbers. Raises UserError: it is something else."""
    if value is None:
        return None
    try:
        first, second = map(float, value)
        good = math.isfinite(first) and math.isfinite(second) and fits(first, second)
    except (TypeError, ValueError):
        good = False
    if not good:
        raise UserError(f"{name} = {value!r}: must be two numbers, {must}")
    return first, second


def own_axes(panels: int) -> list[Axes]:
    """The axes to draw in, if the caller has some. Raises UserError: they are not as many as the
    plot has panels."""
    axes = look().ax
    if axes and len(axes) != panels:
        raise UserError(f"ax: the plot has {panels} panels, and ax is {len(axes)}")
    return [*axes]


@contextmanager
def _one_line(path: Path) -> Iterator[None]:
    """Say what is missing for a file of pgf in one line."""
    try:
        yield
    except (RuntimeError, FileNotFoundError) as problem:
        if path.suffix != ".pgf" or "tex" not in str(problem).lower():
            raise
        raise UserError(f"{path}: takes LaTeX, of which matplotlib asks sizes; {problem}") from None


def save(axes: Axes | Sequence[Axes], path: str | Path, *formats: str) -> list[Path]:
    """Write the figure of some axes, and what they show as numbers.

    Args:
        axes: that a plot returns.
        path: of the files without suffix, or of one with.
        formats: of ``pdf``, ``svg``, ``pgf``, ``png`` and ``csv``; the suffix of ``path`` if none
            is given, or else pdf, svg and csv. The CSV has a row a point: panel, curve, x, y, as
            drawn, so that a curve of many ticks has the least and the largest value of each pixel;
            and the value, where colours show one.

    Returns:
        The files.

    Raises:
        UserError: no such format; pgf without LaTeX.
        OSError: a file cannot be written.
    """
    from matplotlib import rc_context

    each: list[Axes] = [*np.ravel(np.asarray(axes, dtype=object))]
    path = Path(path)
    suffix = path.suffix.removeprefix(".")
    if not formats and suffix in FORMATS:
        path, formats = path.with_suffix(""), (suffix,)
    files = []
    for kind in formats or ("pdf", "svg", "csv"):
        if kind not in FORMATS:
            raise UserError(f"format {kind!r}: {allowed(kind, FORMATS)}")
        file = path.with_name(f"{path.name}.{kind}")
        figure: Any = each[0].get_figure()
        if kind == "csv":
            _write_csv(file, each)
        else:
            with rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}), _one_line(file):
                figure.savefig(file, format=kind)
        files.append(file)
    return files


def _write_csv(file: Path, axes: Sequence[Axes]) -> None:
    with replacing(file) as part, part.open("w", encoding="utf-8", newline="") as text:
        writer = csv.writer(text)
        rows = [
            (panel.get_ylabel() or panel.get_title(loc="left") or str(k + 1), label, columns)
            for k, panel in enumerate(axes)
            for label, columns in _points(panel)
        ]
        coloured = any(len(columns) == 3 for *_, columns in rows)
        writer.writerow(("panel", "curve", "x", "y", *["value"] * coloured))
        for name, label, columns in rows:
            label = "" if label.startswith("_") else label  # matplotlib's own numbers
            no_value = [""] * (coloured and len(columns) == 2)
            for point in zip(*columns, strict=True):
                writer.writerow((name, label, *(f"{x:.9g}" for x in point), *no_value))


def _points(panel: Axes) -> Iterator[tuple[str, Sequence[Any]]]:
    """The labels of a panel's curves, and their columns: x and y, and the value that the colour of
    a point or of a cell shows."""
    from matplotlib.collections import PathCollection, QuadMesh
    from matplotlib.patches import StepPatch

    for line in panel.lines:
        if line.get_transform() == panel.transData:  # else it goes across the panel
            points: Any = line.get_data()
            yield str(line.get_label()), points
    for drawn in panel.collections:
        values: NDArray[np.float64] = np.ma.filled(
            np.ma.asarray(drawn.get_array(), float), np.nan
        ).ravel()
        if isinstance(drawn, QuadMesh):
            edges = np.asarray(drawn.get_coordinates())
            x, y = np.meshgrid(_middles(edges[0, :, 0]), _middles(edges[:, 0, 1]))
            yield str(drawn.get_label()), (x.ravel(), y.ravel(), values)
        elif isinstance(drawn, PathCollection):
            yield str(drawn.get_label()), (*np.asarray(drawn.get_offsets()).T, values)
    for patch in panel.patches:
        if isinstance(patch, StepPatch):
            values, edges, _ = patch.get_data()
            yield str(patch.get_label()), (edges[:-1], values)


def _middles(edges: NDArray[np.float64]) -> list[float]:
    """The points between which matplotlib has put the edges of cells, halfway."""
    found = [float(edges[0] + edges[1]) / 2]
    for edge in edges[1:-1]:
        found.append(float(2 * edge) - found[-1])
    return found


def legend(where: Axes | Figure, **more: Any) -> None:
    """A legend in small letters without a frame; ``more``: as matplotlib's own takes it."""
    where.legend(**{"fontsize": rc("legend.fontsize", 8), "frameon": False, **more})


def figure_of(axes: Sequence[Axes]) -> Figure:
    """The figure of some axes."""
    figure: Any = axes[0].get_figure()
    return figure
