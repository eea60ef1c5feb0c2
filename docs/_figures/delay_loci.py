"""Modes of the sampled loop over its delay, printed beside deployable gains."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from _figures.common import FIGURES, dress, number, write_table
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gfm_design.model.closed_loop import ClosedLoop
from gfm_hil.results.figures import COLOURS
from gfm_plant import Plant

LAWS = (("mimo-gfm", "printed gains"), ("mimo-gfm-deployable", "deployable gains"))
SENSORS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("ideal sensors", {}),
    ("300 Hz sensors", {"sensors": {"bandwidth_hz": 300.0}}),
)
DELAYS = np.arange(0.0, 500.5, 2.5)  # us
LC, BELOW = (900.0, 1300.0), (20.0, 900.0)  # Hz


def _loop(law: str, sensors: int) -> ClosedLoop:
    return ClosedLoop.of(law, Plant.model_validate(SENSORS[sensors][1]))


@cache
def poles(law: str, sensors: int) -> tuple[NDArray[np.complex128], ...]:
    """log(z)/T_s of the upper half plane [1/s, rad/s], for each of DELAYS."""
    loop, found = _loop(law, sensors), []
    for delay in DELAYS:
        s = loop.later(delay * 1e-6).poles()
        found.append(s[s.imag >= 0.0])
    return tuple(found)


def loci() -> None:
    """The s-plane: LC modes with ideal sensors above, all below 500 Hz with real ones below."""
    figure = Figure(figsize=(9.6, 6.6), layout="constrained")
    axes = figure.subplots(2, 2, sharex="row", sharey="row")
    shown = None
    spans = (((-45, 38), (1050, 1200)), ((-420, 200), (-12, 470)))
    for row, (x, y) in enumerate(spans):
        for a, (law, name) in zip(axes[row], LAWS, strict=True):
            a.axvspan(0, x[1], color=COLOURS[1], alpha=0.09, lw=0)
            a.axvline(0, color="#444444", lw=0.8)
            for delay, s in zip(DELAYS, poles(law, row), strict=True):
                whole = delay % 100 == 0
                shown = a.scatter(
                    s.real, s.imag / (2 * np.pi), c=np.full(len(s), delay), cmap="viridis",
                    vmin=0, vmax=500, s=26 if whole else 4, lw=0, zorder=3 if whole else 2,
                )  # fmt: skip
            if row == 0:
                own = np.linalg.eigvals(_loop(law, row).plant.A)
                a.plot(own.real, own.imag / (2 * np.pi), "x", color="k", ms=7, zorder=4)
            a.set_xlim(*x)
            a.set_ylim(*y)
            dress(a, f"{name}, {SENSORS[row][0]}")
            a.set_xlabel("σ [1/s]", fontsize=9)
        axes[row, 0].set_ylabel("frequency [Hz]", fontsize=9)
        axes[row, 0].annotate("grows", (x[1], y[0]), (-4, 5), textcoords="offset points",
                              ha="right", fontsize=8.5)  # fmt: skip
    axes[0, 0].annotate("× with u held constant", (-45, 1050), (6, 6), textcoords="offset points",
                        fontsize=8.5)  # fmt: skip
    assert shown is not None
    bar = figure.colorbar(shown, ax=axes, fraction=0.03, ticks=[0, 100, 200, 300, 400, 500])
    bar.set_label("loop delay [µs]", fontsize=9)
    figure.savefig(FIGURES / "delay_loci.png", dpi=110)


def _ratio(s: NDArray[np.complex128], band: tuple[float, float]) -> float:
    """Damping ratio of the least damped mode of a band, NaN if there is none."""
    f = s.imag / (2 * np.pi)
    some = s[(f > band[0]) & (f < band[1])]
    return float((-some.real / np.abs(some)).min()) if len(some) else np.nan


def damping() -> None:
    """Damping ratio over the delay: of the LC modes, and of what the sensors bring about."""
    figure = Figure(figsize=(9.6, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    cases = ((0, LC, "LC modes, ideal sensors"), (1, BELOW, "20 to 900 Hz, 300 Hz sensors"))
    for a, (sensors, band, title) in zip(panels, cases, strict=True):
        for (law, name), colour in zip(LAWS, (COLOURS[1], COLOURS[0]), strict=True):
            ratio = [100 * _ratio(s, band) for s in poles(law, sensors)]
            a.plot(DELAYS, ratio, color=colour, lw=1.6, label=name)
        a.axhspan(-100, 0, color=COLOURS[1], alpha=0.09, lw=0)
        a.axhline(0, color="#444444", lw=0.8)
        a.set_xlim(0, 500)
        a.set_xlabel("loop delay [µs]", fontsize=9)
        dress(a, f"least damping ratio [%], {title}")
    panels[0].set_ylim(-0.55, 0.7)
    panels[1].set_ylim(-12, 45)
    panels[0].legend(fontsize=8.5, frameon=False, loc="upper right")
    figure.savefig(FIGURES / "delay_damping.png", dpi=110)


def table() -> None:
    """Where each loop holds, and its longest lasting oscillation at the worst delay."""
    rows = []
    for law, name in LAWS:
        for k, (sensors, _) in enumerate(SENSORS):
            found = poles(law, k)
            fast = [s[s.imag > 2 * np.pi * BELOW[0]] for s in found]
            worst = np.array([s[np.argmax(s.real)] for s in fast])
            at = int(np.argmax(worst.real))
            what = f"{number(worst[at].real, 1)} 1/s at {worst[at].imag / (2 * np.pi):.0f} Hz"
            holds = np.array([s.real.max() < 0.0 for s in found])
            rows.append([name, sensors, _ranges(holds), f"{what}, {DELAYS[at]:.0f} µs"])
    head = [
        "gains",
        "sensors",
        "stable at a delay of",
        "longest lasting mode above 20 Hz, at worst",
    ]
    write_table("delay_loci", head, rows)


def _ranges(holds: NDArray[np.bool_]) -> str:
    """Stretches of DELAYS, e.g. 0–50, 295–500 µs."""
    edges = np.flatnonzero(np.diff(np.r_[0, holds.astype(int), 0]))
    spans = [f"{DELAYS[a]:.0f} to {DELAYS[b - 1]:.0f}" for a, b in edges.reshape(-1, 2)]
    return ", ".join(spans) + " µs"
