"""Figures of docs/deployable.md: sigma over delay, line and resistance, overshoot, the frontier.

Usage, in examples/paper: python -m deployable.figures    (about a minute; the frontier is drawn
from deployable/frontier.csv, which deployable.frontier writes)
"""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from deployable.bench import step_run
from deployable.box import Box, Point
from deployable.robust import Loops
from gfm_design.tuning.gains import free_gains
from gfm_runtime import law_file

FIGURES = Path(__file__).resolve().parents[3] / "docs" / "_static" / "figures"
LAWS = ("mimo-gfm", "mimo-gfm-deployable")
NAMES = ("printed gains", "deployable gains")
RIG_LAW, RIG_R = "mimo-gfm-deployable-rig", (0.33, 1.0, 3.0)
FRONTIER = Path(__file__).resolve().parent / "frontier.csv"
MET = (0.1, 0.005)  # 1/s, a part of the step: the searches ask for so much more than is needed
RESISTANCE = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 3.0)


def sigma(law: str, points: list[Point]) -> Any:
    """Largest sigma of a law at each point, 1/s."""
    gains = free_gains(law_file(law))
    return Loops(law_file(law), gains, points).sigma(np.array([g.start for g in gains]))


def region() -> None:
    """sigma over L_g and delay, worst over R_f, R_g in {0.1, 1, 3} and P_ref in {0, 0.5, 1}."""
    lines, delays = np.geomspace(0.5, 30.0, 25), np.linspace(1.0, 10.0, 19)
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for axis, law, name in zip(axes, LAWS, NAMES, strict=True):
        box = Box(L_g=tuple(lines), delay=tuple(delays), P_ref=(0.0, 1.0), dc=("controlled",))
        points = box.corners()
        found = sigma(law, points).reshape(3, 3, len(lines), len(delays), 2)
        worst = found.max(axis=(0, 1, 4)).T
        shown = axis.contourf(
            lines,
            1e2 * delays,
            worst,
            [-1e3, -1.0, 0.0, 1e3],
            colors=["#7fbf8f", "#f2e3a0", "#d98880"],
        )
        assert shown is not None
        axis.plot([0.8, 20, 20, 0.8, 0.8], [100, 100, 500, 500, 100], "k--", lw=1)
        axis.set(xscale="log", xlabel="L_g / nominal", title=name)
    axes[0].set_ylabel("loop delay [µs]")
    figure.suptitle("green: σ ≤ −1 1/s, yellow: stable, red: unstable; dashed: the box", fontsize=9)
    figure.savefig(FIGURES / "deployable_region.png", dpi=150)


def resistance() -> None:
    """What limits alpha: sigma over R_f = R_g, worst of L_g, delay and P_ref."""
    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    axis = figure.subplots()
    for dc in Box().dc:
        worst = []
        for R in RESISTANCE:
            corners = replace(Box(), R_f=(R,), R_g=(R,), dc=(dc,)).corners()
            worst.append(sigma(LAWS[1], corners).max())
        axis.plot(RESISTANCE, worst, "o-", label=f"DC source {dc}")
    axis.axhline(-1.0, color="k", ls="--", lw=1)
    axis.axvline(0.1, color="k", ls="--", lw=1)
    axis.set(
        xscale="log", xlabel="R_f, R_g / nominal", ylabel="σ, worst of L_g, delay, P_ref [1/s]"
    )
    axis.legend(fontsize=8)
    figure.savefig(FIGURES / "deployable_resistance.png", dpi=150)


def overshoot() -> None:
    """The nonlinear bench: overshoot of every step from 0.5 to 1 p.u. over L_g, both sources."""
    both, rig = Box(delay=(1.0, 5.0), P_ref=(0.5,)), {"R_f": RIG_R, "R_g": RIG_R}
    shown = (
        (LAWS[1], replace(both, dc=("controlled",)), "controlled"),
        (LAWS[1], replace(both, dc=("regulated",)), "regulated"),
        (RIG_LAW, replace(both, dc=("regulated",), **rig), "regulated, its law, R ≥ × 0.33"),
    )
    figure = Figure(figsize=(5.5, 3.2), layout="constrained")
    axis = figure.subplots()
    for k, (law, box, name) in enumerate(shown):
        runs = [step_run(p, law) for p in box.corners()]
        shift = 0.96 + 0.04 * k
        axis.plot(
            [shift * r.point.L_g for r in runs],
            [100 * r.overshoot for r in runs],
            ".",
            label=f"DC source {name}",
        )
    axis.plot([0.7, 3.6, 3.6, 23], [5, 5, 20, 20], "k--", lw=1, label="asked for")
    axis.set(xscale="log", xlabel="L_g / nominal", ylabel="overshoot [% of the step]")
    figure.legend(loc="outside upper center", ncols=2, fontsize=8)
    figure.savefig(FIGURES / "deployable_overshoot.png", dpi=150)


def frontier() -> None:
    """The least gamma found over what is asked; hollow where the search did not meet it all.

    The line is the least gamma of all points that are asked as much or more: these gains hold too.
    """
    with FRONTIER.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    panels = (
        ("controlled", "delay", 100.0, "largest loop delay [µs], $L_g$ to × 20"),
        ("regulated", "R", 1.0, "least $R_f$, $R_g$ / nominal"),
        ("regulated", "overshoot", 100.0, "overshoot allowed [%], R ≥ × 0.33"),
    )
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    for axis, (dc, moved, factor, label) in zip(figure.subplots(1, 3), panels, strict=True):
        some = [r for r in rows if (r["dc"], r["moved"]) == (dc, moved)]
        some.sort(key=lambda r: float(r["value"]))
        if moved != "delay":  # the smaller, the more is asked
            some.reverse()
        colour = "C0" if dc == "controlled" else "C1"
        for met, fill in ((True, "full"), (False, "none")):
            found = [r for r in some if is_met(r) == met]
            value = [factor * float(r["value"]) for r in found]
            gamma = np.array([float(r["gamma"]) for r in found])
            axis.plot(value, gamma, "o", color=colour, fillstyle=fill)
            if met:
                axis.plot(value, np.minimum.accumulate(gamma[::-1])[::-1], "-", color=colour)
        axis.set(xlabel=label, title=f"DC source {dc}", ylabel="γ beside this source")
        axis.set_ylim(1.0, 1.1 * max(float(r["gamma"]) for r in some))
    figure.savefig(FIGURES / "deployable_frontier.png", dpi=150)


def is_met(row: dict[str, str]) -> bool:
    """Whether a line of the table keeps what is needed."""
    return float(row["slow"]) <= MET[0] and float(row["beyond"]) <= MET[1]


if __name__ == "__main__":
    region()
    resistance()
    overshoot()
    frontier()
