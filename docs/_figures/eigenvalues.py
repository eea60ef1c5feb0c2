"""Tables and the figure that come from eigenvalues alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from _figures.common import FIGURES, GREY, LAWS, RIG, modes, number, signed, within, write_table
from matplotlib.figure import Figure

from gfm_hil.results.figures import COLOURS, dress


def ideal_table() -> None:
    """The oscillations of the paper's ideal simulation, law continuous and sampled."""
    rows = []
    for law in LAWS:
        for kind, ideal in (("continuous", True), ("100 µs, no delay", False)):
            found = [m for m in modes(law, {}, ideal=ideal) if m.frequency_hz > 1e-3]
            text = ", ".join(f"{signed(m.sigma)} at {m.frequency_hz:.1f} Hz" for m in found[:5])
            rows.append([law.replace("-", "\u2011"), kind, text])
    write_table("ideal_modes", ["law", "controller", "oscillations [1/s]"], rows)


def bandwidth_table() -> None:
    """MIMO-GFM as printed: the LC resonance over sensor bandwidth and delay, nominal elements."""
    delays = (0.0, 1.0, 1.5, 2.0)
    rows = []
    for bandwidth in (None, 2000.0, 1000.0, 500.0, 300.0, 200.0, 100.0):
        cells = []
        for delay in delays:
            plant: dict[str, Any] = {"delay": {"samples": int(delay), "fraction": delay % 1}}
            if bandwidth:
                plant["sensors"] = {"bandwidth_hz": bandwidth}
            worst = within(modes("mimo-gfm", plant), 20.0, 5000.0)
            cells.append(f"{signed(worst.sigma)} at {worst.frequency_hz:.0f}")
        rows.append([f"{bandwidth:g} Hz" if bandwidth else "none", *cells])
    head = ["sensor bandwidth", *[f"{d:g} sample{'s' * (d != 1)}" for d in delays]]
    write_table("bandwidth", head, rows)


def resistance_figure() -> None:
    """VSG-2's 50 Hz mode and MIMO-GFM's LC resonance over the factor on R_f and R_g."""
    factors = np.linspace(0.2, 1.5, 53)

    def sweep(law: str, low: float, high: float) -> list[float]:
        return [
            within(modes(law, {**RIG, "factors": {"R_f": a, "R_g": a}}), low, high).sigma
            for a in factors
        ]

    curves = (
        ("VSG-2, near 50 Hz", sweep("vsg-2", 40, 60), COLOURS[1], "-"),
        ("the same with E_u fixed (droop-3)", sweep("droop-3", 40, 60), GREY, "--"),
        ("droop-5, near 53 Hz", sweep("droop-5", 40, 60), COLOURS[2], "-"),
        ("MIMO-GFM, LC resonance at 1075 Hz", sweep("mimo-gfm", 900, 1300), COLOURS[0], "-"),
    )
    figure = Figure(figsize=(8.6, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.axhspan(0, 30, color="#b34500", alpha=0.07, lw=0)
    axes.axhline(0, color="#444444", lw=0.8)
    axes.axvline(0.5, color=GREY, lw=0.8, ls=(0, (4, 3)))
    axes.annotate("rig scenarios", (0.5, -40), (4, 4), textcoords="offset points", fontsize=8.5)
    axes.annotate("grows", (1.5, 0), (-4, 5), textcoords="offset points", ha="right", fontsize=8.5)
    for label, sigma, colour, style in curves:
        axes.plot(factors, sigma, color=colour, ls=style, lw=1.6, label=label)
    axes.set_ylim(-42, 26)
    axes.set_xlim(0.2, 1.5)
    axes.set_xlabel("factor on $R_f$ and $R_g$", fontsize=9)
    dress(axes, "growth rate σ [1/s] of the oscillation")
    axes.legend(fontsize=8.5, frameon=False, loc="upper right", ncols=2)
    figure.savefig(FIGURES / "resistance.png", dpi=110)

    def crossing(law: str, band: tuple[float, float], names: Sequence[str]) -> float:
        low, high = 0.2, 1.5
        for _ in range(30):
            middle = (low + high) / 2
            plant = {**RIG, "factors": dict.fromkeys(names, middle)}
            grows = within(modes(law, plant), *band).sigma > 0
            low, high = (middle, high) if grows else (low, middle)
        return high

    rows = [
        ["VSG-2, 50 Hz", "R_f and R_g", number(crossing("vsg-2", (40, 60), ("R_f", "R_g")), 3)],
        ["VSG-2, 50 Hz", "R_g alone", number(crossing("vsg-2", (40, 60), ("R_g",)), 3)],
        [
            "MIMO-GFM, 1075 Hz", "R_f and R_g",
            number(crossing("mimo-gfm", (900, 1300), ("R_f", "R_g")), 3),
        ],
    ]  # fmt: skip
    write_table("resistance", ["mode", "factor on", "unstable below"], rows)


def imperfection_table() -> None:
    """What each imperfection of the rig does to VSG-2's 50 Hz mode."""

    def spread(cases: Sequence[dict[str, Any]]) -> str:
        found = [within(modes("vsg-2", {**RIG, **case}), 40, 60).sigma for case in cases]
        low, high = signed(min(found)), signed(max(found))
        return low if low == high else f"{low} to {high}"

    def sensors(**more: Any) -> dict[str, Any]:
        return {"sensors": {"bandwidth_hz": 300.0, **more}}

    delays = [{"delay": {"samples": n, "fraction": x}} for n in (0, 1, 2) for x in (0.0, 0.5)]
    bands = [{"sensors": {"bandwidth_hz": b}} for b in (300.0, 500.0, 1000.0, 2000.0)]
    parts = [{"factors": {e: a}} for e in ("L_f", "L_g", "C_f", "C_dc") for a in (0.9, 1.1)]
    gains = [sensors(gain={c: a}) for c in ("v_dc", "p", "q", "V") for a in (0.95, 1.05)]
    offsets = [sensors(offset={c: a}) for c in ("v_dc", "p", "q", "V") for a in (-0.01, 0.01)]
    resistors = [{"factors": {"R_f": a, "R_g": a}} for a in (0.9, 1.1)]
    rows = [
        ["delay 0 to 2.5 samples", spread(delays)],
        ["sensors 300 Hz to 2 kHz, or ideal", spread([*bands, {"sensors": {}}])],
        ["any L or C ± 10 %", spread(parts)],
        ["gain of any sensor ± 5 %", spread(gains)],
        ["offset of any sensor ± 0.01 p.u.", spread(offsets)],
        ["$R_f$ and $R_g$ ± 10 %", spread(resistors)],
        ["$R_f$ and $R_g$ × 0.5", spread([{"factors": {"R_f": 0.5, "R_g": 0.5}}])],
    ]
    write_table("imperfections", ["imperfection", "σ of the mode near 50 Hz [1/s]"], rows)


def couplings_table() -> None:
    """MIMO-GFM without one of its paths from the DC voltage."""
    rows = []
    cases: tuple[tuple[str, dict[str, float]], ...] = (
        ("as printed", {}),
        ("$k_{21} = 0$", {"k_21": 0.0}),
        ("$k_{31} = 0$", {"k_31": 0.0}),
    )
    for label, gains in cases:
        found = [m for m in modes("mimo-gfm", {}, ideal=True, **gains) if 0 < m.frequency_hz < 900]
        text = ", ".join(f"{signed(m.sigma)} at {m.frequency_hz:.1f} Hz" for m in found)
        rows.append([label, text])
    write_table("couplings", ["MIMO-GFM", "oscillations below 900 Hz [1/s]"], rows)


def q_droop_table() -> None:
    """droop-5 over its gain from q to E_u: the LC resonance."""
    rows = []
    for k in (0.005, 0.01, 0.02, 0.05):
        cells = [
            within(modes("droop-5", {}, ideal=True, k_34=k), 900, 1300),
            within(modes("droop-5", {}, k_34=k), 900, 1300),
            within(modes("droop-5", {"delay": {"samples": 1}}, k_34=k), 900, 1300),
        ]
        rows.append([f"{k:g}", *[signed(m.sigma) for m in cells]])
    head = ["$k_{34}$", "continuous", "100 µs, no delay", "100 µs, one sample"]
    write_table("q_droop", head, rows)
