"""The step experiments and the switchover: figures, and what the summaries say."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _figures.common import DOCS, FIGURES, LAWS, number, run, scenario, write_table

from gfm_hil.results.figures import draw_comparison, draw_run
from gfm_hil.run.runner import Run

COLUMNS = (
    ("p_peak", "p peak [p.u.]", 3),
    ("p_final", "p final [p.u.]", 3),
    ("overshoot_pct", "overshoot [%]", 0),
    ("settling_s", "settling 2 % [s]", 2),
    ("f_nadir_hz", "f nadir [Hz]", 3),
    ("f_peak_hz", "f peak [Hz]", 3),
    ("rocof_hz_s", "RoCoF [Hz/s]", 2),
    ("damping_ratio", "swing: damping ratio", 3),
    ("oscillation_hz", "swing [Hz]", 2),
)


def step_table(name: str, runs: dict[str, Run]) -> None:
    """What the summaries of several runs say of their first event."""
    rows = []
    for label, one in runs.items():
        events = one.summary["events"]
        if one.summary["status"] == "oscillating":
            label += ", oscillating"
        if one.summary["status"] in ("completed", "oscillating"):
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
    other = str(DOCS / "examples" / "droop-5-integral.toml")
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


def switchover() -> None:
    """MIMO-GFM to VSG-2 on the rig: the run's own figure."""
    case = scenario("switchover")
    one = run(case)
    with tempfile.TemporaryDirectory() as place:
        shown = {**one.signals, **window(one, 0.8, 4.0)}
        with draw_run(replace(one, scenario=case, columns=shown, folder=Path(place))):
            pass
        shutil.move(Path(place) / "signals.png", FIGURES / "switchover.png")
    s = one.summary
    mantissa, exponent = f"{s['bump_pu'][0]:.1e}".split("e")
    write_table(
        "switchover",
        ["status", "bump of u [p.u.]", "oscillation of p", "damping ratio", "reason"],
        [[
            s["status"], f"${mantissa}\\cdot10^{{{int(exponent)}}}$",
            f"{s['events'][0]['fast_hz']:.1f} Hz",
            number(s["events"][0]["fast_damping_ratio"], 3), s["reason"].replace("|", "\\|"),
        ]],
    )  # fmt: skip
