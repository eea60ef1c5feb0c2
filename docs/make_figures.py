"""Figures and tables of docs/experiments.md: runs the scenarios in process and writes

    docs/_static/figures/*.png    the figures
    docs/tables/*.md              the numbers that the page quotes

Usage: python docs/make_figures.py    (about half a minute; nothing else is needed)
"""

from __future__ import annotations

import math
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gfm_design.linear import Mode, ideal_modes, loop_modes
from gfm_design.operating_point import operating_point
from gfm_hil.figures import COLOURS, draw_comparison, draw_run
from gfm_hil.runner import Run, run_scenario
from gfm_hil.scenario import Scenario, check_scenario, find_scenario
from gfm_plant import Plant, make_plant
from gfm_runtime import discretise, get_law

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_ext"))
FIGURES, TABLES = HERE / "_static" / "figures", HERE / "tables"
LAWS = ("mimo-gfm", "vsg-2", "droop-5")
T_S = 1e-4
REF = np.array([1.0, 0.5, 1.0, 0.0, 1.0])
RIG: dict[str, Any] = {
    "delay": {"samples": 1},
    "sensors": {"bandwidth_hz": 300.0},
    "dc_source": {"mode": "regulated"},
}
LSB = 2.0 / 2**12  # of E_u on the DS2101, p.u.
GREY = "#888888"


# --- running and measuring ---------------------------------------------------------------------


def scenario(name: str, **changed: Any) -> Scenario:
    """A shipped scenario, in process, with keys changed (dotted path, __ for the dot)."""
    content = tomllib.loads(find_scenario(name).read_text(encoding="utf-8"))
    content |= {"mode": "lockstep", "link": {"type": "inproc"}}
    for path, value in changed.items():
        *parents, last = path.split("__")
        place = content
        for parent in parents:
            place = place.setdefault(parent, {})
        if value is None:
            place.pop(last, None)
        else:
            place[last] = value
    return check_scenario(content, name)


def run(case: Scenario) -> Run:
    """Run it; only the signals and the summary are kept."""
    with tempfile.TemporaryDirectory() as place:
        return run_scenario(case, Path(place) / "run", figures=False)


def modes(law: str, plant: dict[str, Any], ideal: bool = False, **gains: float) -> list[Mode]:
    """Modes of a law's loop, longest lasting first."""
    par, _ = make_plant(Plant.model_validate(plant), T_S)
    discrete = discretise(get_law(law, **gains), T_S)
    op = operating_point(par, discrete, REF)
    if ideal:
        return ideal_modes(par, discrete.law, op, REF)
    return loop_modes(par, discrete, op, REF)


def within(found: Sequence[Mode], low: float, high: float) -> Mode:
    """The longest lasting mode of a band, Hz."""
    return next(m for m in found if low < m.frequency_hz < high)


def number(value: float | None, digits: int = 3) -> str:
    """For a table."""
    if value is None:
        return "–"
    return f"{value:.{digits}f}".replace("-", "−")


def signed(value: float) -> str:
    """A growth rate; what grows is bold."""
    return f"**+{value:.2f}**" if value >= 0 else f"{value:.2f}".replace("-", "−")


def write_table(name: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A Markdown table for the page to include."""
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    (TABLES / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


COLUMNS = (
    ("p_peak", "p peak [p.u.]", 3),
    ("p_final", "p final [p.u.]", 3),
    ("overshoot_pct", "overshoot [%]", 0),
    ("settling_s", "settling 2 % [s]", 2),
    ("f_nadir_hz", "f nadir [Hz]", 3),
    ("f_peak_hz", "f peak [Hz]", 3),
    ("rocof_hz_s", "RoCoF [Hz/s]", 2),
    ("damping_ratio", "damping ratio", 3),
    ("oscillation_hz", "at [Hz]", 2),
)


def step_table(name: str, runs: dict[str, Run]) -> None:
    """What the summaries of several runs say of their first event."""
    rows = []
    for label, one in runs.items():
        events = one.summary["events"]
        if one.summary["status"] == "completed":
            cells = [number(events[0].get(key), digits) for key, _, digits in COLUMNS]
        else:
            t = one.summary["duration_s"]
            cells = [f"{one.summary['status']} at {t:.3f} s"] + ["–"] * (len(COLUMNS) - 1)
        rows.append([label.replace("-", "\u2011"), *cells])
    write_table(name, ["", *[title for _, title, _ in COLUMNS]], rows)


def window(one: Run, start: float, stop: float) -> dict[str, Any]:
    """The signals between two times."""
    t = one.signals["t"]
    inside = (t >= start) & (t <= stop)
    return {k: v[inside] for k, v in one.signals.items() if len(v) == len(t)}


def compared(picture: str, name: str, start: float, stop: float) -> None:
    """The paper's simulation under three laws: figure and table."""
    cases = {law: scenario(name, law=law) for law in LAWS}
    runs = {law: run(case) for law, case in cases.items()}
    step_table(picture, runs)
    signals = {law: window(one, start, stop) for law, one in runs.items()}
    events = runs[LAWS[0]].summary["events"]
    draw_comparison(FIGURES / f"{picture}.png", cases[LAWS[0]], signals, events)


def equivalence() -> None:
    """How far droop-5 is from VSG-2 for a disturbance of each kind."""
    other = str(HERE / "examples" / "droop-5-integral.toml")
    rows = []
    for label, law in (("droop-5", "droop-5"), ("droop-5 with row 3 of VSG-2", other)):
        cells = []
        for name in ("grid_frequency_step", "pref_step"):
            runs = [run(scenario(name, law=one)).signals["true_p"] for one in (law, "vsg-2")]
            cells.append(f"{np.abs(runs[0] - runs[1]).max():.2g}")
        rows.append([label, *cells])
    head = ["largest difference of p to VSG-2 [p.u.]", "grid frequency step", "P_ref step"]
    write_table("equivalence", head, rows)


def rig(picture: str, name: str, ideal: str, start: float, stop: float) -> None:
    """The rig with MIMO-GFM beside the ideal simulation; the table has all three laws."""
    runs = {law: run(scenario(name, law=law)) for law in LAWS}
    step_table(picture, runs)
    shown = {"mimo-gfm on the rig": runs["mimo-gfm"], "mimo-gfm, ideal": run(scenario(ideal))}
    signals = {label: window(one, start, stop) for label, one in shown.items()}
    events = runs["mimo-gfm"].summary["events"]
    draw_comparison(FIGURES / f"{picture}.png", scenario(name), signals, events)


def switchover() -> None:
    """MIMO-GFM to VSG-2 on the rig: the run's own figure."""
    case = scenario("switchover")
    one = run(case)
    with tempfile.TemporaryDirectory() as place:
        shown = {**one.signals, **window(one, 0.8, 4.0)}
        laws = [case.law, "vsg-2"]
        drawn = draw_run(Path(place), case, shown, {}, one.summary, laws)
        shutil.move(drawn[0], FIGURES / "switchover.png")
    s = one.summary
    mantissa, exponent = f"{s['bump_pu'][0]:.1e}".split("e")
    write_table(
        "switchover",
        ["status", "bump of u [p.u.]", "oscillation of p", "damping ratio", "reason"],
        [[
            s["status"], f"${mantissa}\\cdot10^{{{int(exponent)}}}$",
            f"{s['events'][0]['oscillation_hz']:.1f} Hz",
            number(s["events"][0]["damping_ratio"], 3), s["reason"].replace("|", "\\|"),
        ]],
    )  # fmt: skip


# --- eigenvalues -------------------------------------------------------------------------------


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
    FigureCanvasAgg(figure)
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
    axes.set_title("growth rate σ [1/s] of the oscillation", loc="left", fontsize=9.5)
    axes.grid(True, color="#e4e4e4", lw=0.6)
    axes.tick_params(labelsize=8.5)
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


def rig_tables() -> None:
    """What the rig's overshoot and its ripple come from."""
    rows = []
    for label, source in (
        ("controlled by row 1", {"mode": "controlled"}),
        ("regulated, $k_p$ = 90, $k_i$ = 400 1/s (VSG-2's row 1)", {"mode": "regulated"}),
        (
            "regulated, $k_p$ = 120.224, $k_i$ = 265.6217 1/s (MIMO-GFM's row 1)",
            {"mode": "regulated", "k_p": 120.224, "k_i": 265.6217},
        ),
    ):
        event = run(scenario("pref_step", plant__dc_source=source)).summary["events"][0]
        rows.append([label, number(event["overshoot_pct"], 1)])
    write_table("dc_source", ["DC source, all else ideal", "overshoot of p [%]"], rows)
    rows = []
    for label, change in (
        ("noise and 12-bit D/A", {}),
        ("noise alone", {"plant__dac": None}),
        ("12-bit D/A alone", {"plant__sensors__noise_std": None}),
        ("neither", {"plant__sensors__noise_std": None, "plant__dac": None, "plant__adc": None}),
    ):
        p = run(scenario("rig_pref_step", duration=2.0, **change)).signals["true_p"][2000:10000]
        rows.append([label, f"{p.std():.2g}"])
    write_table("ripple", ["", "standard deviation of p at rest [p.u.]"], rows)


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


# --- the D/A and the small limit cycle ---------------------------------------------------------

CHOKES: tuple[dict[str, float], ...] = (
    {},
    {"R_g": 0.5},
    {"R_g": 0.25},
    {"R_f": 0.5, "R_g": 0.5},
)


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
                "switchover", duration=8.0, expect="completed", plant__factors=factors,
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
    FigureCanvasAgg(figure)
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
        a.set_title(f"{name}: active power p [p.u.]", loc="left", fontsize=9.5)
        a.axvline(1.0, color=GREY, lw=0.8, ls=(0, (4, 3)))
        a.grid(True, color="#e4e4e4", lw=0.6)
        a.tick_params(labelsize=8.5)
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
    par, _ = make_plant(Plant.model_validate(plant), T_S)
    phi = operating_point(par, discretise(get_law("vsg-2"), T_S), REF).u[2] / LSB % 1.0
    sine, cosine = math.sin(math.pi * phi), abs(math.cos(math.pi * phi))
    least = 2 * sine * (1 + cosine) / math.pi
    if least < kappa:
        E = one.signals["u_E_u"][-20000:]
        said = f"{2 * sine / (math.pi * kappa):.2f} LSB"
        shown = f"{math.sqrt(2) * E.std() / LSB:.2f} LSB"
    else:
        said, shown = "none: grows", one.summary["status"]
    return [f"{kappa:.3f}", f"{phi:.3f}", f"{least:.3f}", said, shown]


def terminal() -> None:
    """What the two commands that run the bench print, for cli.md."""
    from outputs import command

    for name, line in (
        ("cli_run", "gfmhil run switchover --mode lockstep --out runs/switchover --quiet"),
        ("cli_compare", "gfmhil compare pref_step --link inproc --out runs/pref_step --quiet"),
    ):
        with tempfile.TemporaryDirectory() as place:
            text = command(line, folder=Path(place))
        (TABLES / f"{name}.md").write_text(text + "\n", encoding="utf-8")


def main() -> None:
    """Everything."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    TABLES.mkdir(parents=True, exist_ok=True)
    compared("pref_step", "pref_step", 0.8, 3.0)
    compared("grid_frequency_step", "grid_frequency_step", 0.8, 3.0)
    rig("rig_pref_step", "rig_pref_step", "pref_step", 0.8, 3.0)
    rig("rig_grid_frequency_step", "rig_grid_frequency_step", "grid_frequency_step", 0.8, 3.0)
    equivalence()
    switchover()
    ideal_table()
    bandwidth_table()
    resistance_figure()
    imperfection_table()
    couplings_table()
    rig_tables()
    q_droop_table()
    limit_cycles()
    terminal()


if __name__ == "__main__":
    main()
