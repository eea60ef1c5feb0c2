"""VSG-2 on a 12-bit D/A: the limit cycle, and what the describing function says of it."""

from __future__ import annotations

import math
from typing import Any

from _figures.common import FIGURES, GREY, RIG, modes, run, scenario, signed, within, write_table
from _figures.steps import window
from matplotlib.figure import Figure

from gfm_design.model.closed_loop import ClosedLoop
from gfm_hil.results.figures import COLOURS, dress
from gfm_hil.run.runner import Run
from gfm_plant import Plant

LSB = 2.0 / 2**12  # of E_u on the DS2101, p.u.
CHOKES: tuple[dict[str, float], ...] = ({}, {"R_g": 0.5}, {"R_g": 0.25}, {"R_f": 0.5, "R_g": 0.5})


def limit_cycles() -> None:
    """VSG-2 after the change of law on several chokes, with the 12-bit D/A and without."""
    rows, theory, drawn = [], [], {}
    for factors in CHOKES:
        name = ", ".join(f"{k} × {v:g}" for k, v in factors.items()) or "nominal"
        plant = {**RIG, "factors": factors}
        sigma = within(modes("vsg-2", plant), 40, 60).sigma
        cells = []
        for dac in ("DS2101", None):
            case = scenario(
                "switchover", duration=8.0, plant__factors=factors,
                plant__dac=dac,
            )  # fmt: skip
            one = run(case)
            drawn[name, dac] = one
            if one.summary["status"] == "tripped":
                cells += [f"trips after {one.summary['duration_s'] - 1.0:.2f} s"]
            else:
                p = one.signals["true_p"][-20000:]
                cells += [f"stays, ripple of p {math.sqrt(2) * p.std():.4f}"]
        rows.append([name, signed(sigma), *cells])
        theory.append([name, *_relay(plant, drawn[name, "DS2101"])])
    head = ["chokes", "σ, linear [1/s]", "12-bit D/A", "D/A without rounding"]
    write_table("limit_cycles", head, rows)
    head = ["chokes", "$\\kappa$", "$\\varphi$", "least $N$", "E_u predicted", "E_u measured"]
    write_table("relay", head, theory)
    figure = Figure(figsize=(8.6, 4.6), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    panels = (("R_g × 0.5", 0.06), ("R_f × 0.5, R_g × 0.5", 0.6))
    for a, (name, span) in zip(axes, panels, strict=True):
        for dac, colour, label in (
            (None, COLOURS[1], "D/A without rounding"),
            ("DS2101", COLOURS[0], "12-bit D/A"),
        ):
            s = window(drawn[name, dac], 0.8, 4.0)
            a.plot(s["t"], s["true_p"], color=colour, lw=0.5, label=label)
        a.set_ylim(0.5 - span, 0.5 + span)
        dress(a, f"{name}: active power p [p.u.]")
        a.axvline(1.0, color=GREY, lw=0.8, ls=(0, (4, 3)))
    axes[0].legend(fontsize=8.5, frameon=False, loc="upper right", ncols=2)
    axes[0].annotate("law vsg-2", (1.0, 0.44), (4, 4), textcoords="offset points", fontsize=8.5)
    axes[1].set_xlabel("t [s]", fontsize=9)
    figure.savefig(FIGURES / "limit_cycle.png", dpi=110)


def _relay(plant: dict[str, Any], one: Run) -> list[str]:
    """The describing function of two D/A codes beside what the run shows; see experiments.md."""
    low, high = 0.0, 2.0
    for _ in range(40):
        kappa = (low + high) / 2
        found = modes("vsg-2", plant, k_34=1.9048 * kappa, k_35=38.0954 * kappa)
        low, high = (kappa, high) if within(found, 40, 60).sigma < 0 else (low, kappa)
    op = ClosedLoop.of("vsg-2", Plant.model_validate(plant)).made_of.op
    phi = op.u[2] / LSB % 1.0
    sine, cosine = math.sin(math.pi * phi), abs(math.cos(math.pi * phi))
    least = 2 * sine * (1 + cosine) / math.pi
    if least < kappa:
        E = one.signals["u_E_u"][-20000:]
        said = f"{2 * sine / (math.pi * kappa):.2f} LSB"
        shown = f"{math.sqrt(2) * E.std() / LSB:.2f} LSB"
    else:
        said, shown = "none: grows", one.summary["status"]
    return [f"{kappa:.3f}", f"{phi:.3f}", f"{least:.3f}", said, shown]
