"""What loses VSG-2 on the rig: dead time, resistance and compensation, law by law, beside what the
describing function says."""

from __future__ import annotations

import tempfile
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from _figures.common import FIGURES, RIG, run, scenario, signed, write_table
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import argrelextrema

from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.dead_time import with_dead_time
from gfm_design.model.linear import Mode
from gfm_hil.results.figures import COLOURS, dress
from gfm_hil.run.runner import Run
from gfm_plant import Plant

LAWS = ("vsg-2", "droop-5", "mimo-gfm", "mimo-gfm-practical")
TIMES = (0.0, 1e-6, 2e-6, 3e-6)
_CHANGE, _LASTS = 1.0, 8.0  # s
_SMALL, _LARGE = 0.02, 0.35  # p.u. of p; between these an oscillation grows as the linear loop does


def dead_time() -> None:
    """The maps of the laws, the growth of the swing, and the figure."""
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for law in LAWS:
            for seconds in TIMES:
                cells = [law.replace("-", "\u2011"), f"{1e6 * seconds:g} µs"]
                cells += [_words(_run(law, seconds, factor)) for factor in (0.5, 0.7, 1.0)]
                compensated = _compensated(Path(place), seconds) if seconds else None
                cells += [_words(_run(law, seconds, 1.0, compensated)) if compensated else "–"]
                rows.append(cells)
    head = ["law", "dead time", "0.5 R", "0.7 R", "R", "R, compensated"]
    write_table("dead_time_map", head, rows)
    _swing_table()
    _figure()


def _run(law: str, seconds: float, factor: float, counts: Path | None = None) -> Run:
    """The switchover to a law (to MIMO-GFM: none) on a switched bridge."""
    bridge = {"kind": "two-level", "dead_time_s": seconds}
    events = [{"t": _CHANGE, "type": "law", "law": law}] if law != "mimo-gfm" else []
    more: dict[str, Any] = {}
    if counts is not None:
        more = {"counts": str(counts), "plant__phases": {"bits": 12}, "plant__dac": None}
    return run(
        scenario(
            "switchover", duration=_LASTS, events=events, expect=None, expect_reason=None,
            expect_after=None, plant__bridge=bridge,
            plant__factors={"R_f": factor, "R_g": factor}, **more,
        )
    )  # fmt: skip


def _compensated(place: Path, seconds: float) -> Path:
    """The counts of ``rig-dead-time`` for another dead time."""
    shipped = files("gfm_runtime").joinpath("counts_files/rig-dead-time.toml")
    text = shipped.read_text("utf-8").replace("dead_time_s = 2e-6", f"dead_time_s = {seconds:g}")
    file = place / f"dead-time-{1e6 * seconds:g}.toml"
    file.write_text(text, encoding="utf-8")
    return file


def _words(one: Run) -> str:
    """How a run ended: when it tripped, or the oscillation that is left."""
    if one.status in ("tripped", "safe"):
        after = one.summary["duration_s"] - _CHANGE
        return f"**{one.status.replace('safe', 'SAFE')} after {after:.2f} s**"
    p = np.asarray(one.columns["true_p"][-10000:])
    lines = np.abs(np.fft.rfft((p - p.mean()) * np.hanning(len(p))))
    return f"{np.ptp(p):.3f} at {np.argmax(lines):.0f} Hz"


def extremes(one: Run) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Instants after the change of law, s, and half the distance between neighbouring extremes of
    p as a one-cycle mean, p.u."""
    cycle = 200
    p = np.asarray(one.columns["true_p"][round(_CHANGE / 1e-4) :])
    mean = np.convolve(p, np.ones(cycle) / cycle, "valid")
    at = np.sort(
        np.concatenate(
            [argrelextrema(mean, which, order=300)[0] for which in (np.greater, np.less)]
        )
    )
    middle = np.array([(a + b) / 2 for a, b in pairwise(at)]) * 1e-4
    return middle, np.abs(np.diff(mean[at])) / 2


def measured(one: Run) -> tuple[float, float] | None:
    """Growth rate, 1/s, and frequency, Hz, of the swing of a run; None if it does not swing."""
    t, size = extremes(one)
    large = np.flatnonzero(size >= _LARGE)
    fits = (size > _SMALL) & (np.arange(len(size)) < (large[0] if len(large) else len(size)))
    if fits.sum() < 3:
        return None
    sigma = float(np.polyfit(t[fits], np.log(size[fits]), 1)[0])
    return sigma, float(1 / (2 * np.mean(np.diff(t[fits]))))


def predicted(law: str, seconds: float) -> Mode:
    """The swing mode of the loop with dead time, on nominal chokes."""
    loop = with_dead_time(ClosedLoop.of(law, Plant.model_validate(RIG)), seconds)
    return next(m for m in loop.modes() if 0.5 < m.frequency_hz < 20)


def _swing_table() -> None:
    rows = []
    for seconds in (1e-6, 1.5e-6, 2e-6, 2.5e-6, 3e-6):
        said, shown = predicted("vsg-2", seconds), measured(_run("vsg-2", seconds, 1.0))
        cells = [f"{signed(said.sigma)} at {said.frequency_hz:.1f} Hz"]
        cells += ["dies away" if shown is None else f"{signed(shown[0])} at {shown[1]:.1f} Hz"]
        others = [signed(predicted(law, seconds).sigma) for law in LAWS[1:]]
        rows.append([f"{1e6 * seconds:g} µs", *cells, *others])
    head = ["dead time", "VSG-2, describing function", "VSG-2, run", *LAWS[1:]]
    write_table("dead_time_swing", head, rows)


def _figure() -> None:
    figure = Figure(figsize=(8.6, 6.2), layout="constrained")
    upper, lower = figure.subplots(2, 1)
    times = np.linspace(0, 3e-6, 13)
    for law, colour in zip((*LAWS, "droop-3"), COLOURS, strict=False):
        sigma = [predicted(law, t).sigma for t in times]
        style = "--" if law == "droop-3" else "-"
        label = "VSG-2 with E_u fixed (droop-3)" if law == "droop-3" else law
        upper.plot(1e6 * times, sigma, color=colour, ls=style, lw=1.4, label=label)
    found = [(t, measured(_run("vsg-2", t, 1.0))) for t in (1.5e-6, 2e-6, 2.5e-6, 3e-6)]
    points = [(1e6 * t, shown[0]) for t, shown in found if shown is not None]
    upper.plot(*zip(*points, strict=True), "o", color=COLOURS[0], ms=5, label="vsg-2, runs")
    upper.axhline(0, color="#444444", lw=0.8)
    upper.set_ylim(-22, 11)
    upper.set_xlabel("dead time [µs]", fontsize=9)
    upper.legend(fontsize=8, frameon=False, ncols=3, loc="lower right")
    dress(upper, "growth rate of the swing [1/s], nominal chokes")
    with tempfile.TemporaryDirectory() as place:
        for label, counts, law, colour in (
            ("VSG-2", None, "vsg-2", COLOURS[0]),
            ("VSG-2, compensated", _compensated(Path(place), 2e-6), "vsg-2", COLOURS[1]),
            ("MIMO-GFM", None, "mimo-gfm", COLOURS[2]),
        ):
            one = _run(law, 2e-6, 1.0, counts)
            last = round(2.6 / 1e-4)
            t, p = (np.asarray(one.columns[name][8000:last]) for name in ("t", "true_p"))
            lower.plot(t, p, color=colour, lw=0.6, label=label)
    lower.axvline(_CHANGE, color="#888888", lw=0.8, ls=(0, (4, 3)))
    lower.set_ylim(-1.5, 2.5)
    lower.set_xlabel("t [s]", fontsize=9)
    lower.legend(fontsize=8, frameon=False, ncols=3, loc="upper left")
    dress(lower, "p after the change of law at 2 µs of dead time [p.u.]")
    figure.savefig(FIGURES / "dead_time.png", dpi=110)


if __name__ == "__main__":
    dead_time()
