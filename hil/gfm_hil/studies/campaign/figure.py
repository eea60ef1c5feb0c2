"""The map of a campaign: what became of every run over two parameters, one panel a law."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from gfm_hil.results.figures import dress
from gfm_hil.studies.campaign.result import VERDICTS, Axis, verdict
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import Record

Vector = NDArray[np.float64]

LOOKS = {  # colour, marker, size: told apart without colour too
    "stable": ("#0072B2", "o", 9),
    "oscillating": ("#E69F00", "D", 13),
    "tripped": ("#D55E00", "x", 17),
    "safe": ("#CC79A7", "^", 17),
    "no-steady-state": ("#777777", "s", 13),
}
_SHADE = LinearSegmentedColormap.from_list("share", ["#f6d9c6", "#ffffff", "#cfe3f1"])
_CELLS = 90  # a side of the background
_REACH = 0.06  # of an axis: how far a run tells about its surroundings (one sigma)
_UNKNOWN = 0.3  # runs; where fewer are near, the share is unknown: one half
_LEAST = 60  # runs; fewer tell no share


def fill_map(
    figure: Figure, campaign: Campaign, records: Sequence[Record], x: Axis, y: Axis | None
) -> list[Axes]:
    """Fill a figure with the map, one panel a law; returns the panels.

    Without a second axis the runs are spread by their number.
    """
    laws = campaign.file.laws
    columns = min(len(laws), 3)
    rows = -(-len(laws) // columns)
    figure.set_size_inches(0.8 + 4.7 * columns, 1.1 + 4.3 * rows)
    figure.set_layout_engine("constrained")
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    found: set[str] = set()
    for axes, law in zip(panels.ravel(), laws, strict=False):
        mine = [r for r in records if r["law"] == law]
        found |= _panel(axes, campaign, law, mine, x, y)
    for axes in panels.ravel()[len(laws) :]:
        axes.set_axis_off()
    for axes in panels[-1]:
        axes.set_xlabel(x.label, fontsize=9.5)
    for axes in panels[:, 0]:
        axes.set_ylabel(y.label if y else "run", fontsize=9.5)
    handles = [
        panels[0, 0].scatter([], [], c=c, marker=m, s=1.8 * s, lw=1.2, label=v.replace("-", " "))
        for v, (c, m, s) in LOOKS.items()
        if v in found
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False, fontsize=9)
    figure.suptitle(campaign.file.title, fontsize=11.5, x=0.01, ha="left")
    return list(panels.ravel()[: len(laws)])


def _panel(
    axes: Axes, campaign: Campaign, law: str, records: Sequence[Record], x: Axis, y: Axis | None
) -> set[str]:
    """One law; returns the verdicts that were drawn."""
    a = spread(x, records, 1)
    b = spread(y, records, 2) if y else np.array([r["run"] for r in records], dtype=float)
    verdicts = np.array([verdict(r) for r in records], dtype=object)
    dress(axes)
    axes.grid(False)
    if x.log:
        axes.set_xscale("log")
    if y and y.log:
        axes.set_yscale("log")
    if len(records) >= _LEAST and y is not None:
        _background(axes, a, b, verdicts == "stable", x.log, y.log)
    for name in VERDICTS:
        colour, marker, size = LOOKS[name]
        here = verdicts == name
        edge, width = (None, 1.2) if marker == "x" else ("white", 0.4)
        axes.scatter(
            a[here], b[here], s=size, c=colour, marker=marker, zorder=3, edgecolors=edge, lw=width
        )
    counts = " · ".join(
        f"{n} {v.replace('-', ' ')}" for v in VERDICTS if (n := int((verdicts == v).sum()))
    )
    axes.set_title(law, loc="left", fontsize=10.5, color="#222222", pad=18)
    axes.text(0, 1.015, counts, transform=axes.transAxes, fontsize=8.5, color="#555555")
    _tidy(axes, x, y)
    return set(verdicts)


def spread(axis: Axis, records: Sequence[Record], salt: int) -> Vector:
    """Values of an axis; those of a choice are shifted aside, always alike."""
    values = axis.values(records)
    aside = np.random.Philox(key=salt).random_raw(1 + max((r["run"] for r in records), default=0))
    share = np.array([int(aside[r["run"]]) / 2**64 for r in records]) - 0.5
    return values + 2 * axis.apart * share


def _background(
    axes: Axes, a: Vector, b: Vector, stable: NDArray[np.bool_], log_x: bool, log_y: bool
) -> None:
    """Shade by the share of stable runs nearby; a line where it is one half."""
    p, x = _unit(np.log(a) if log_x else a)
    q, y = _unit(np.log(b) if log_y else b)
    cells = (np.arange(_CELLS) + 0.5) / _CELLS
    near = np.exp(-((cells[:, None] - p) ** 2) / (2 * _REACH**2))
    weight = np.exp(-((cells[:, None] - q) ** 2) / (2 * _REACH**2))
    runs = weight @ near.T + _UNKNOWN  # (y, x)
    share = (weight @ (near * stable).T + _UNKNOWN / 2) / runs
    at_x, at_y = x(cells), y(cells)
    at_x, at_y = (np.exp(at_x) if log_x else at_x), (np.exp(at_y) if log_y else at_y)
    axes.pcolormesh(
        at_x, at_y, share, cmap=_SHADE, vmin=0, vmax=1, shading="nearest", zorder=0, rasterized=True
    )
    if share.min() < 0.5 < share.max():
        axes.contour(at_x, at_y, share, [0.5], colors="#444444", linewidths=1.0, zorder=2)


def _unit(values: Vector):  # type: ignore[no-untyped-def]
    """Values on [0, 1], and the way back."""
    low, high = values.min(), values.max()
    width = (high - low) or 1.0
    return (values - low) / width, lambda share: low + share * width


def _tidy(axes: Axes, x: Axis, y: Axis | None) -> None:
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    for axis, drawn in ((x, axes.xaxis), (y, axes.yaxis)):
        if axis and axis.words:
            drawn.set_ticks(range(len(axis.words)), axis.words)
        elif axis and axis.log:
            drawn.set_major_locator(LogLocator(subs=(1, 2, 5)))
            drawn.set_major_formatter(plain)
            drawn.set_minor_formatter(NullFormatter())
    axes.margins(0.02)
