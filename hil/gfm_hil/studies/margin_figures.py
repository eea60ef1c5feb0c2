"""Two figures of margins: the stable region over the line, and sigma over the added delay."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from gfm_design.margins.tolerance import Region, factor
from gfm_design.model.closed_loop import ClosedLoop
from gfm_hil.results.figures import COLOURS, GREY, dress
from gfm_hil.results.look import figure_of, look

_SPAN = 100.0  # 1/s; colours of sigma end there
_DELAYS = 300
_NOWHERE = "#dddddd"
_NO_POINT = Line2D([], [], color=_NOWHERE, marker="s", ls="", label="no operating point")
_EDGE = Line2D([], [], color="k", lw=1.2, label="σ = 0")


def draw_sigma(
    axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], sigma: NDArray[np.float64]
) -> list[Line2D]:
    """The largest real part of the poles [1/s], shape (len(y), len(x)), in colour, and its zero as
    a line; grey where there is no operating point. Returns what of this a legend explains."""
    axes.set_facecolor(_NOWHERE)
    # evenly spaced in decades on both sides of zero: from growing fast to hardly damped and back
    decades = AsinhNorm(1.0, -_SPAN, _SPAN)
    mesh = axes.pcolormesh(x, y, sigma, cmap="RdBu_r", norm=decades, shading="nearest")
    finite = np.nan_to_num(np.arcsinh(sigma), nan=1.0)
    crosses = bool(finite.min() < 0.0 < finite.max())
    if crosses:
        axes.contour(x, y, finite, levels=[0.0], colors="k", linewidths=1.2)
    close = () if look().paper else (-1.0, 1.0)  # to 0, where the bar is short
    ticks = [-100.0, -10.0, 0.0, 10.0, 100.0, *close]
    bar = figure_of([axes]).colorbar(
        mesh, ax=axes, ticks=ticks, format="%g", label="largest σ [1/s]"
    )
    bar.minorticks_off()
    return [_EDGE] * crosses + [_NO_POINT] * bool(np.isnan(sigma).any())


def draw_region(path: Path, loop: ClosedLoop, label: str, region: Region) -> None:
    """sigma in colour, its zero as a line, the printed and the scenario's line as points."""
    figure = Figure(figsize=(6.6, 5.2), layout="constrained")
    axes = figure.subplots()
    explained = draw_sigma(axes, region.L_g, region.R_g, region.sigma)
    axes.plot(1.0, 1.0, "o", color="k", ms=6, mfc="none")
    axes.plot(factor(loop, "L_g"), max(factor(loop, "R_g"), region.R_g[0]), "k*", ms=9)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("L_g over its printed value")
    axes.set_ylabel("R_g over its printed value")
    axes.set_title(f"{label}: stable where σ < 0", loc="left", fontsize=10)
    marks = [
        Line2D([], [], color="k", marker="o", mfc="none", ls="", label="printed"),
        Line2D([], [], color="k", marker="*", ms=9, ls="", label="scenario"),
    ]
    axes.legend(handles=[*marks, *explained], fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)


def draw_delay(path: Path, loop: ClosedLoop, label: str, margin: float) -> None:
    """The largest sigma over the added delay of all of u; ``margin`` in s, inf if none found."""
    assert loop.T_s is not None
    end = 1.5 * margin if np.isfinite(margin) else 20 * loop.T_s
    delays = np.linspace(0.0, end, _DELAYS)
    sigma = [loop.later(float(d)).sigma() for d in delays]
    figure = Figure(figsize=(6.6, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(1e6 * delays, sigma, color=COLOURS[0], lw=1.4)
    axes.axhline(0.0, color=GREY, lw=0.8)
    if np.isfinite(margin):
        axes.axvline(1e6 * margin, color=COLOURS[1], lw=1.0, ls=(0, (4, 3)))
        axes.annotate(
            f"{1e6 * margin:.4g} µs", (1e6 * margin, 0.0), (-4, 6), textcoords="offset points",
            ha="right", color=COLOURS[1], fontsize=9,
        )  # fmt: skip
    axes.set_xlabel(f"delay on top of the loop's {1e6 * loop.u_delay[0]:g} µs [µs]")
    axes.set_ylabel("largest σ [1/s]")
    dress(axes, f"{label}: the loop over its delay")
    figure.savefig(path, dpi=110)
