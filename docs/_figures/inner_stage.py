"""The figures and the table of inner-stage.md: the blocks, and two faults with and without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from _figures.common import FIGURES, GREY, arrow, box, number, run, scenario, signed, write_table
from matplotlib.figure import Figure

from gfm_design.margins.delays import overall_delay
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.results.figures import COLOURS, dress
from gfm_hil.run.cycles import cycle_means, cycle_ticks
from gfm_hil.scenario import load_scenario
from gfm_hil.scenario.expectation import reason_name
from gfm_plant import Plant
from gfm_runtime import load_law
from gfm_runtime.inner_file import inner_names

_LAWS, _SCRS = ("vsg-2", "droop-3", "mimo-gfm-practical"), (1.5, 3.0, 10.0)
_PLANT = {"delay": {"samples": 1, "fraction": 0.3}, "modulation": "space-vector"}
_SLOWEST, _SPLIT = 1e-3, 20.0  # Hz; what turns more slowly is no oscillation; swings lie below
_LAW, _STAGE, _GUARD = COLOURS[0], COLOURS[2], COLOURS[1]
_AT, _DIP_S = 0.5, 0.15
_CASES = {
    "-25° phase jump": {"t": _AT, "type": "grid-phase-jump", "degrees": -25.0},
    "V_g = 0 for 150 ms": {"t": _AT, "type": "grid-voltage", "V_g": 0.0, "duration": _DIP_S},
}
_SHOWN = (_AT - 0.05, _AT + 0.45)  # s


def blocks() -> None:
    """What lies between the law and the bridge."""
    figure = Figure(figsize=(10.2, 3.3), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(0, 10.2), ylim=(0, 3.2), aspect="equal")
    axes.axis("off")
    box(axes, (0.1, 1.35), (1.3, 1.7), "law\nΦ(s)", _LAW)
    box(axes, (2.0, 2.5), (1.5, 0.6), "power limiter", _GUARD)
    box(axes, (2.0, 1.35), (1.75, 0.75), "virtual stator,\nor voltage loop", _STAGE)
    box(axes, (4.5, 1.35), (1.15, 0.75), "limit\n|i*| ≤ I_max", _GUARD)
    box(axes, (6.3, 1.35), (1.2, 0.75), "current loop", _STAGE)
    box(axes, (8.1, 1.35), (1.25, 0.75), "limit\n|e| ≤ m v_dc", _GUARD)
    box(axes, (0.1, 0.15), (1.3, 0.6), "PLL: ω_g\nfor column 3", _STAGE)
    for start, end, text in (
        ((1.4, 2.8), (2.0, 2.8), "ω_u"),
        ((3.5, 2.8), (10.1, 2.8), "ω to the bridge's angle"),
        ((1.4, 1.72), (2.0, 1.72), "E_u"),
        ((3.75, 1.72), (4.5, 1.72), "i*"),
        ((5.65, 1.72), (6.3, 1.72), "i*"),
        ((7.5, 1.72), (8.1, 1.72), "e"),
        ((9.35, 1.72), (10.1, 1.72), "E_u + jE_q"),
    ):
        arrow(axes, start, end, GREY)
        middle = (start[0] + end[0]) / 2
        axes.text(middle, start[1] + 0.08, text, ha="center", fontsize=8, color=GREY)
    axes.plot([1.4, 9.9], [0.45, 0.45], color=GREY, lw=1.0)
    axes.text(9.95, 0.45, "i, v, i_o", fontsize=8, color=GREY, va="center", ha="right",
              backgroundcolor="white")  # fmt: skip
    for x in (2.85, 6.9):
        arrow(axes, (x, 0.45), (x, 1.35), GREY)
    arrow(axes, (0.4, 0.75), (0.4, 1.35), GREY)
    axes.plot([5.07, 5.07, 1.1], [1.35, 0.95, 0.95], color=_GUARD, lw=1.0, ls=(0, (4, 3)))
    arrow(axes, (1.1, 0.95), (1.1, 1.35), _GUARD)
    axes.text(3.0, 1.03, "while limited: hold the law's E_u row", fontsize=8, color=_GUARD)
    figure.savefig(FIGURES / "inner_blocks.png", dpi=110)


def _most(one: Run) -> tuple[float, float | None]:
    """Largest |i_dq| after the event, and largest mean of it over one cycle, p.u.; None if the run
    ended before."""
    i, first = one.signals["i"], round(_AT / one.scenario.T_s)
    width = cycle_ticks(one.scenario.T_s, nominal_frequency(one.scenario))
    means = [piece.max() for piece in cycle_means(i, first, len(i), width)]
    return float(i[first:].max()), float(max(means)) if means else None


def faults() -> None:
    """VSG-2 at SCR 3 with every stage: a jump of the grid's angle, and a dip to nothing."""
    figure = Figure(figsize=(10.2, 5.6), layout="constrained")
    axes = figure.subplots(2, len(_CASES), sharex=True, squeeze=False)
    rows = []
    for k, (title, event) in enumerate(_CASES.items()):
        for stage, colour in zip(inner_names(), COLOURS, strict=False):
            one = run(scenario("phase_jump_within_rating", inner=stage, events=[event]))
            peak, mean = _most(one)
            ended = one.summary["status"]
            if ended == "tripped":
                ended = f"{reason_name(one.summary['reason'])} at {one.summary['duration_s']:.3f} s"
            p = one.signals["p"][-1] if one.status == "completed" else None
            rows.append([title, f"`{stage}`", number(peak, 2), number(mean, 2), number(p), ended])
            t = one.signals["t"]
            inside = (t >= _SHOWN[0]) & (t <= _SHOWN[1])
            for a, name in zip(axes[:, k], ("i", "p"), strict=True):
                a.plot(t[inside], one.signals[name][inside], color=colour, lw=1.0, label=stage)
        dress(axes[0, k], f"{title}: |i_dq| [p.u.]")
        dress(axes[1, k], "active power p [p.u.]")
        axes[1, k].set_xlabel("t [s]", fontsize=9)
    axes[0, 1].legend(fontsize=8, frameon=False)
    figure.savefig(FIGURES / "inner_faults.png", dpi=110)
    head = ["VSG-2, SCR 3", "stage", "peak of $\\lvert i_{dq} \\rvert$"]
    head += ["its largest one-cycle mean", "$p$ at the end", "run"]
    write_table("inner_faults", head, rows)


def loops() -> None:
    """The linear loop of three laws behind every stage, in a weak, a middling and a strong grid."""
    rows = []
    for stage in inner_names():
        for law in _LAWS:
            cells = []
            for scr in _SCRS:
                plant = {**_PLANT, "grid": {"scr": scr, "x_over_r": 6.0}}
                loop = ClosedLoop.of(load_law(law, stage).laws[0], Plant.model_validate(plant))
                found = loop.modes()
                swing = _least_damped(found, _SLOWEST, _SPLIT, 1)
                fast = _least_damped(found, _SPLIT, np.inf, 0)
                delay = 1e6 * overall_delay(loop).seconds
                cells.append(f"{swing}; {fast}; {delay:.0f} µs")
            rows.append([f"`{stage}`", law.replace("-", "\u2011"), *cells])
    heads = [f"SCR {scr:g}" for scr in _SCRS]
    write_table("inner_modes", ["stage", "law", *heads], rows)


def unbalance() -> None:
    """The negative sequence, and the largest current of a phase, in unbalanced faults."""
    rows = []
    for kind in ("LL", "LG", "LLG"):
        for scr in _SCRS:
            for stage in ("virtual-stator", "dual-sequence"):
                fault = {"t": 0.5, "type": "fault", "kind": kind, "position": 0.5, "R": 0.0}
                plant = {**_PLANT, "grid": {"scr": scr, "x_over_r": 6.0}}
                content = {"title": "unbalanced fault", "duration": 2.0, "law": "vsg-2"}
                content |= {"plant": plant, "events": [{**fault, "duration": 0.5}]}
                one = run(load_scenario(content, in_process=True, inner=stage))
                turn = np.exp(1j * 2 * np.pi * nominal_frequency(one.scenario) * one.signals["t"])
                v, i = (
                    one.columns[f"true_{x}_re"] + 1j * one.columns[f"true_{x}_im"] for x in "vi"
                )
                late, stays = slice(9000, 10_000), slice(6000, 10_000)
                V2, I2 = (np.conj(np.mean(z[late] * turn[late] ** 2)) for z in (v, i))
                phases = i[stays] * turn[stays] * np.exp(-2j * np.pi / 3 * np.arange(3)[:, None])
                lead = np.degrees(np.angle(I2 / V2)) % 360.0
                peak = float(np.max(np.abs(phases.real)))
                cells = [f"{lead:.1f}°", number(abs(I2), 2), number(peak, 2), one.status]
                rows.append([kind, f"{scr:g}", f"`{stage}`", *cells])
    head = ["fault", "SCR", "stage", "$I_2$ leads $V_2$ by", "$\\lvert I_2\\rvert$"]
    write_table("inner_unbalance", [*head, "largest current of a phase", "run"], rows)


def sequence() -> None:
    """How far the reactance of the negative sequence may be from the stator's."""
    rows, scrs = [], (1.0, 1.5, 3.0, 10.0, 20.0)
    law = load_law("vsg-2", "dual-sequence").laws[0]
    for X_n in (0.2, 0.3, 0.45, 0.6, 0.9, 1.2):
        cells = []
        for scr in scrs:
            plant = {**_PLANT, "grid": {"scr": scr, "x_over_r": 6.0}, "lcl": {"L": 0.15}}
            stage = law.inner.model_copy(update={"X_n": X_n, "R_n": 0.1 * X_n})
            loop = ClosedLoop.of(replace(law, inner=stage), Plant.model_validate(plant))
            cells.append(_least_damped(loop.modes(), _SPLIT, np.inf, 0))
        rows.append([f"{X_n:g}", *cells])
    write_table("inner_sequence", ["$X_n$", *(f"SCR {scr:g}" for scr in scrs)], rows)


def _least_damped(modes: list[Mode], low: float, high: float, digits: int) -> str:
    """The oscillation between two frequencies [Hz] that lasts longest, if there is one."""
    for mode in modes:  # in this order
        if low < mode.frequency_hz <= high:
            return f"{signed(mode.sigma)} at {mode.frequency_hz:.{digits}f} Hz"
    return "–"


def inner_stage() -> None:
    """All of the page."""
    blocks()
    loops()
    faults()
    unbalance()
    sequence()
