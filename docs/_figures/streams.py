"""The figure of ports.md: a run drawn from its MF4 file alone."""

from __future__ import annotations

import tempfile
from pathlib import Path

from _figures.common import FIGURES, GREY, dress, scenario
from asammdf import MDF
from matplotlib.figure import Figure

from gfm_hil.results.export import export_run
from gfm_hil.results.figures import COLOURS
from gfm_hil.run.runner import run_scenario

_SHOWN = ("y_p", "y_omega_u", "u_i_u")


def from_mf4() -> None:
    """Two laws and two steps, as asammdf reads them."""
    events = [
        {"type": "reference", "t": 0.2, "P_ref": 0.8},
        {"type": "law", "t": 0.7, "law": "mimo-gfm"},
        {"type": "grid-frequency", "t": 1.2, "f_hz": 49.98},
    ]
    case = scenario("pref_step", law="droop-5", events=events, duration=1.8)
    with tempfile.TemporaryDirectory() as place:
        run_scenario(case, Path(place) / "run")
        file = Path(place) / "step.mf4"
        export_run(Path(place) / "run", "mf4", file)
        with MDF(file) as mdf:
            _draw(mdf).savefig(FIGURES / "export_mf4.png", dpi=110)


def _draw(mdf: MDF) -> Figure:
    figure = Figure(figsize=(8.2, 6.0), layout="constrained")
    *panels, strip = figure.subplots(
        len(_SHOWN) + 1, 1, sharex=True, height_ratios=[*(1 for _ in _SHOWN), 0.16]
    )
    for axes, name in zip(panels, _SHOWN, strict=True):
        channel = mdf.get(name)
        axes.plot(channel.timestamps, channel.samples, color=COLOURS[0], lw=1.1)
        dress(axes, f"{name} [{channel.unit}]: {channel.comment}")
        axes.ticklabel_format(useOffset=False)
        axes.margins(x=0, y=0.2)
    for event in mdf.events:
        if event.cause == 3 and event.comment and event.name != "end":  # script, of MDF 4.11
            for axes in panels:
                axes.axvline(event.value, color=GREY, lw=0.8, ls=(0, (4, 3)), zorder=1.9)
            if not event.name.startswith("law-"):
                panels[0].annotate(
                    event.comment, (event.value, 1.0), (4, -10), xycoords=("data", "axes fraction"),
                    textcoords="offset points", fontsize=8, color="#444444",
                )  # fmt: skip
    law = mdf.get("law")
    begin = 0
    for k in range(1, len(law.samples) + 1):
        if k == len(law.samples) or law.samples[k] != law.samples[begin]:
            t0, t1 = law.timestamps[begin], law.timestamps[k - 1]
            colour = COLOURS[1 + (begin > 0)]
            strip.axvspan(t0, t1, color=colour, alpha=0.25, lw=0)
            strip.text((t0 + t1) / 2, 0.5, law.samples[begin].decode(), ha="center", va="center",
                       fontsize=8.5, color="#222222")  # fmt: skip
            begin = k
    dress(strip, "law: in words by the channel's value-to-text conversion")
    strip.set_yticks([])
    strip.grid(False)
    strip.spines["left"].set_visible(False)
    strip.set_xlabel("t [s]", fontsize=9)
    return figure
