"""The figure of a window between the ticks: legs, currents, DC link, and the spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gfm_hil.core.errors import UserError
from gfm_hil.recording.columns import PHASES
from gfm_hil.results.figures import COLOURS, dress
from gfm_hil.run.between import BetweenTicks
from gfm_hil.run.spectrum import spectrum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE = (10.5, 8.4)  # inches
_SHOWN = 0.02  # s of a longer window that the curves show
_MOST_HZ = 25e3


def draw_between(figure: Figure, between: BetweenTicks, title: str = "") -> list[Axes]:
    """Fill a figure with the voltages of the legs, the phases of the current of L_f and of the
    line, and v_dc, and below, if the window has 10 cycles, the spectra of phase a's currents. Of a
    window longer than 20 ms the curves show its first 20 ms."""
    b = between.bases
    A = b.I_peak
    axes = figure.subplots(4, 1, height_ratios=(1.1, 1.4, 0.8, 1.3))
    last = int(np.searchsorted(between.t, between.t[0] + _SHOWN * (1 + 1e-9)))
    t = between.t[:last]
    for k, phase in enumerate(PHASES):
        leg = np.append(between.legs, between.legs[-1:], axis=0)[:last, k] * b.V_dcref
        axes[0].step(t, leg + (2 - k) * 1.2 * b.V_dcref, where="post", color=COLOURS[k], lw=0.8)
        axes[1].plot(t, A * between.columns[f"i_{phase}"][:last], color=COLOURS[k], lw=0.7)
        line = A * between.columns[f"i_o{phase}"][:last]
        axes[1].plot(t, line, color=COLOURS[k], lw=1.4, label=phase)
    axes[0].set_yticks([(2 - k) * 1.2 * b.V_dcref for k in range(3)], PHASES)
    axes[2].plot(t, b.V_dcref * between.columns["v_dc"][:last], color=COLOURS[0], lw=0.8)
    axes[2].ticklabel_format(useOffset=False)
    dress(axes[0], f"voltages of the legs against the middle of v_dc, each ±{b.V_dcref / 2:g} V")
    dress(axes[1], "currents of the bridge (thin) and of the line (thick) [A]")
    dress(axes[2], "v_dc [V]")
    above = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0}
    axes[1].legend(fontsize=8, frameon=False, ncols=3, **above)
    for a in axes[:3]:
        a.set_xlim(t[0], t[-1])
    axes[2].set_xlabel("t [s]", fontsize=9)
    _draw_spectrum(axes[3], between, A)
    if title:
        figure.suptitle(title, fontsize=11, x=0.01, ha="left")
    return list(axes)


def _draw_spectrum(axes: Axes, between: BetweenTicks, A: float) -> None:
    try:
        found = {name: spectrum(between, f"{name}a") for name in ("i_", "i_o")}
    except UserError as problem:  # shorter than the standard's window
        axes.text(0.5, 0.5, str(problem), ha="center", va="center", fontsize=9)
        axes.set_axis_off()
        return
    for (name, one), colour in zip(found.items(), COLOURS, strict=False):
        shown = (one.f > 0) & (one.f <= _MOST_HZ)
        of = "bridge" if name == "i_" else "line"
        thds = 100 * one.distortion()["THDS"]
        axes.semilogy(
            one.f[shown] / 1e3, A * one.rms[shown], color=colour, lw=0.7,
            label=f"{of}, THDS {thds:.2f} %",
        )  # fmt: skip
    axes.set_ylim(1e-5 * A, None)
    axes.set_xlim(0, _MOST_HZ / 1e3)
    axes.set_xlabel("frequency [kHz]", fontsize=9)
    axes.legend(fontsize=8, frameon=False, ncols=2, loc="upper right")
    dress(axes, "lines of phase a's currents, RMS [A]")


def plot_between(between: BetweenTicks) -> Sequence[Axes]:
    """Draw legs, currents, v_dc and spectrum with pyplot."""
    from gfm_hil.results.figures import pyplot_figure

    return draw_between(pyplot_figure(SIZE, 4), between)
