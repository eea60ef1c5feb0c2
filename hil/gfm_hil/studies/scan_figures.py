"""Figures of a measured admittance: its entries, passivity, NFP plot, and eigenloci on a grid."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gfm_hil.results.figures import (
    COLOURS,
    complex_plane,
    dress,
    headline,
    pyplot_figure,
    pyplot_panels,
)
from gfm_hil.studies.scan import FrequencyScan

_CELLS = ("dd", "dq", "qd", "qq")


def admittance(of: FrequencyScan) -> list[Axes]:
    """Gain and phase of the four entries: two rows of panels a row of Y."""
    figure = pyplot_figure((9.2, 8.6), 4)
    panels = figure.subplots(4, 2, sharex=True, height_ratios=[3, 2, 3, 2])
    for k, cell in enumerate(_CELLS):
        row, column = divmod(k, 2)
        gain, phase = panels[2 * row, column], panels[2 * row + 1, column]
        measured = of.Y[:, row, column]
        model = None if of.model is None else of.model[:, row, column]
        _bode(gain, phase, of.frequency, measured, model)
        dress(gain, f"Y_{cell}: |Y| [p.u.], phase [°]")
        dress(phase)
    for axes in panels[-1]:
        axes.set_xlabel("frequency in the dq frame [Hz]", fontsize=9.5)
    panels[0, 0].legend(fontsize=8, frameon=False)
    figure.suptitle(
        f"{of.name}: admittance at the filter capacitor", fontsize=11, x=0.01, ha="left"
    )
    return list(panels.ravel())


def passivity(of: FrequencyScan) -> list[Axes]:
    """The least eigenvalue of Y + Y^H, and the deviation of Y from the model."""
    dev, least = of.deviation, of.passivity
    rows = 1 if dev is None else 2
    panels = pyplot_panels(rows, (7.6, 2.9 * rows))
    panels[0].semilogx(of.frequency, least, "o-", color=COLOURS[0], ms=3.5, lw=1.0)
    panels[0].axhline(0.0, color="k", lw=0.8)
    panels[0].fill_between(
        of.frequency, least, 0.0, where=least < 0.0, color=COLOURS[1], alpha=0.25, lw=0
    )
    panels[0].set_yscale("symlog", linthresh=1.0)
    dress(panels[0], f"{of.name}: least eigenvalue of Y + Yᴴ [p.u.], negative: not passive")
    if dev is not None:
        panels[1].loglog(of.frequency, 100 * dev, "o-", color=COLOURS[0], ms=3.5, lw=1.0)
        dress(panels[1], "deviation of the measured Y from the linear model [%]")
    panels[-1].set_xlabel("frequency in the dq frame [Hz]", fontsize=9.5)
    return panels


def nfp(of: FrequencyScan, figure: Figure | None = None) -> list[Axes]:
    """Gain and phase of the change of p over that of the grid's frequency; in a figure of its own
    if none is given."""
    if figure is None:
        figure = pyplot_figure((7.6, 5.6), 2)
        headline(figure, f"{of.name}: network frequency perturbation", 9.5)
    gain, phase = figure.subplots(2, 1, sharex=True)
    _bode(gain, phase, of.frequency, of.nfp, of.nfp_model)
    dress(gain, "|Δp / Δω_g| [p.u./p.u.]")
    dress(phase, "phase [°]")
    gain.legend(fontsize=8, frameon=False)
    phase.set_xlabel("frequency of the perturbation [Hz]", fontsize=9.5)
    return [gain, phase]


def nyquist_on_grid(of: FrequencyScan, scr: float, x_over_r: float) -> Axes:
    """The eigenvalues of Z Y, over positive frequencies, near -1."""
    found = of.stability(scr, x_over_r)
    verdict = {True: "stable", False: "unstable", None: "cannot be judged"}[found.stable]
    title = f"{of.name}, SCR {scr:g}, X/R {x_over_r:g}: {verdict}, margin {found.margin:.2g}"
    loci = {f"λ{k + 1}(Z Y)": z for k, z in enumerate(of.eigenloci(scr, x_over_r).T)}
    return complex_plane(title, loci, (-1.0, found.margin, "margin"), style="o-")


def save_figures(of: FrequencyScan, folder: Path, grids: Sequence[tuple[float, float]]) -> None:
    """All figures as PNG."""
    import matplotlib
    from matplotlib import pyplot

    matplotlib.use("Agg")
    figures: dict[str, Callable[..., object]] = {
        "admittance": admittance, "passivity": passivity, "nfp": nfp
    }  # fmt: skip
    for scr, x_over_r in grids:
        name = f"nyquist_scr_{scr:g}_xr_{x_over_r:g}"
        figures[name] = partial(nyquist_on_grid, scr=scr, x_over_r=x_over_r)
    for name, draw in figures.items():
        draw(of)
        pyplot.savefig(folder / f"{name}.png", dpi=110)
        pyplot.close()


def _bode(
    gain: Axes, phase: Axes, hz: NDArray[np.float64], measured: NDArray[np.complex128],
    model: NDArray[np.complex128] | None,
) -> None:  # fmt: skip
    """A curve of the model and the measured points over it."""
    if model is not None:
        gain.loglog(hz, np.abs(model), color=COLOURS[1], lw=1.2, label="linear model")
        turn = np.degrees(np.angle(model))
        wraps = np.flatnonzero(np.abs(np.diff(turn)) > 180.0) + 1  # where no line is drawn
        phase.semilogx(
            np.insert(hz, wraps, hz[wraps]), np.insert(turn, wraps, np.nan),
            color=COLOURS[1], lw=1.2,
        )  # fmt: skip
    gain.loglog(hz, np.abs(measured), "o", color=COLOURS[0], ms=3.5, label="measured")
    phase.semilogx(hz, np.degrees(np.angle(measured)), "o", color=COLOURS[0], ms=3.5)
    phase.set(ylim=(-190, 190), yticks=(-180, -90, 0, 90, 180))
