"""The figures and the table of identification.md and conformity.md."""

from __future__ import annotations

import numpy as np
from _figures.common import FIGURES, dress, number, run, scenario, write_table
from matplotlib import pyplot
from matplotlib.figure import Figure

from gfm_hil.results.figures import COLOURS
from gfmhil import plot, scan
from gfmhil.envelopes import measure_unit, phase_jump

_LAWS, _STAGES = ("vsg-2", "droop-5", "mimo-gfm"), ("none", "virtual-stator", "cascaded")
_SHOWN = ("vsg-2", "virtual-stator")
_SCR, _XR, _DEGREES = 3.0, 6.0, 10.0


def identification() -> None:
    """The deviation of nine measurements from the linear model, and the figures of one."""
    rows = []
    for law in _LAWS:
        cells = [law]
        for stage in _STAGES:
            found = scan(law, inner=stage)
            dev = found.deviation
            assert dev is not None
            k = int(np.argmax(dev))
            cells.append(f"{number(100 * dev[k], 2)} % at {found.frequency[k]:.3g} Hz")
            if (law, stage) == _SHOWN:
                for name, draw in (
                    ("admittance", plot.admittance),
                    ("passivity", plot.passivity),
                    ("nfp", plot.nfp),
                ):
                    draw(found)
                    pyplot.savefig(FIGURES / f"identification_{name}.png", dpi=110)
                    pyplot.close()
        rows.append(cells)
    write_table("identification", ["law", *_STAGES], rows)
    wide = scan(*_SHOWN[:1], inner=_SHOWN[1], start_hz=0.3, stop_hz=4500.0, points=80)
    plot.nyquist_on_grid(wide, 1.5, 10.0)
    pyplot.savefig(FIGURES / "identification_nyquist.png", dpi=110)
    pyplot.close()


def envelope() -> None:
    """P of VSG-2 with a virtual stator after a phase jump, in the envelope of its own unit."""
    grid = {"scr": _SCR, "x_over_r": _XR}
    unit = measure_unit("vsg-2", inner=_SHOWN[1], plant__grid=grid)
    write_table(
        "envelopes_unit",
        ["D [p.u.]", "H [s]", "X_eff [p.u.]"],
        [[number(unit.D, 1), number(unit.H, 2), number(unit.X_eff, 3)]],
    )
    jump = {"t": 0.5, "type": "grid-phase-jump", "degrees": _DEGREES}
    made = run(
        scenario("pref_step", law="vsg-2", inner=_SHOWN[1], duration=3.5, events=[jump],
                 plant__grid=grid)
    )  # fmt: skip
    t = np.linspace(0.0, 3.0, 1800)
    found = phase_jump(unit, t, np.radians(_DEGREES), _SCR, 0.5)
    p = np.convolve(made.signals["p"], np.ones(200) / 200)[: made.ticks]  # of the cycle before
    figure = Figure(figsize=(7.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    axes.fill_between(
        t, found.lower, found.upper, color=COLOURS[2], alpha=0.2, lw=0, label="envelope"
    )
    axes.plot(t, found.expected, color=COLOURS[2], lw=1.2, label="expected")
    axes.plot(made.signals["t"] - 0.5, p, color=COLOURS[0], lw=1.2, label="p, mean over a cycle")
    axes.set_xlim(-0.1, 1.5)
    axes.set_xlabel("time after the jump [s]", fontsize=9.5)
    dress(
        axes, f"VSG-2 with a virtual stator: the grid's angle jumps by {_DEGREES:g}°, SCR {_SCR:g}"
    )
    axes.legend(fontsize=8, frameon=False)
    figure.savefig(FIGURES / "envelopes_jump.png", dpi=110)
