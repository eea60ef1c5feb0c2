"""The figure of deploy.md: services, what they look at, and where people come in."""

from __future__ import annotations

from _figures.common import FIGURES, GREY, INK, arrow, box
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gfm_hil.results.figures import COLOURS

_LOOP, _WATCH = COLOURS[0], COLOURS[2]
#: service, its row, and who comes to it
_SERVICES = (
    ("gfmhil-modbus@rig", 2, "SunSpec clients", "Modbus/TCP, port 5020", True),
    ("gfmhil-scope@rig", 1, "browsers", "port 8470", True),
    ("gfmhil-stream@rig", 0, "PlotJuggler, own tools,\nPrometheus", "ports 9872 to 9874", False),
)


def services() -> None:
    """Boxes and arrows."""
    figure = Figure(figsize=(9.2, 3.9), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlim=(0, 9.2), ylim=(-0.15, 3.75), aspect="equal")
    axes.axis("off")
    _bench(axes)
    for name, row, who, where, commands in _SERVICES:
        y = 0.35 + row * 1.1
        box(axes, (4.65, y), (1.75, 0.6), name, _WATCH)
        arrow(axes, (3.95, 1.2 + 0.12 * row), (4.6, y + 0.38), GREY)
        if commands:
            arrow(axes, (4.6, y + 0.2), (3.95, 2.45 + 0.14 * row), _WATCH)
        box(axes, (7.3, y), (1.8, 0.6), who, GREY)
        arrow(axes, (6.45, y + 0.3), (7.25, y + 0.3), _WATCH if commands else GREY, commands)
        axes.text(5.52, y - 0.17, where, ha="center", fontsize=7.5, color=GREY)
    figure.savefig(FIGURES / "services.png", dpi=110)


def _bench(axes: Axes) -> None:
    box(axes, (0.1, 0.1), (4.0, 3.35), "", INK, faint=True)
    axes.text(0.25, 3.2, "gfmhil-bench@rig", fontsize=9, color=INK)
    box(axes, (0.3, 1.75), (1.3, 0.6), "plant", _LOOP)
    box(axes, (2.4, 1.75), (1.5, 0.6), "controller", _LOOP)
    arrow(axes, (1.65, 2.05), (2.35, 2.05), _LOOP, both=True)
    axes.text(2.0, 2.13, "link", ha="center", fontsize=7.5, color=_LOOP)
    box(axes, (0.3, 0.75), (3.6, 0.6), "recording: every tick, in memory, append only", GREY)
    arrow(axes, (0.95, 1.7), (0.95, 1.4), _LOOP)
    arrow(axes, (3.15, 1.7), (3.15, 1.4), _LOOP)
    box(axes, (0.3, 2.6), (3.6, 0.45), "command servers: check commands off the loop", GREY)
    for x in (0.95, 3.15):
        arrow(axes, (x, 2.57), (x, 2.39), _WATCH)
    axes.text(0.3, 0.3, "/run/gfmhil/rig → /var/lib/gfmhil/runs/rig-…", fontsize=7.5, color=GREY)
