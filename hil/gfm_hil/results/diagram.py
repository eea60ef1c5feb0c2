"""The single-line diagram of a scenario: converters, filters, lines, loads, machines and grid.

Drawn from the scenario alone, with its parameters in p.u. of each converter; those of a network's
lines, loads and capacitors are in p.u. of the first one, as in the scenario.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Rectangle

from gfm_hil.core.files import replacing
from gfm_hil.results.figures import as_svg, in_a_page
from gfm_hil.results.single_line import Bar, bars_of, converters_of, give_rows
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.fault import Fault
from gfm_plant import Plant, load_converter

_INK, _GREY, _RED = "#222222", "#666666", "#b34500"
_TERMINAL, _LINE, _BARS, _COLUMN = 3.9, 4.9, 6.7, 3.4  # where these begin, and one bar to the next
_ROW = 1.75
#: places of a report: the curves of one converter, and those of some beside each other
OF, ONLY = "of-", "only="


def draw_diagram(
    folder: Path, scenario: Scenario, report: str | None = None, leads_to: str = OF
) -> str:
    """Draw the diagram into network.svg of a run folder; returns it as an element of a page.

    Args:
        report, leads_to: as for ``fill_diagram``; the links of the element are within its own page.
    """
    figure = Figure()
    fill_diagram(figure, scenario, report, leads_to)
    drawn = as_svg(figure)
    with replacing(folder / "network.svg") as part:
        part.write_bytes(drawn)
    root = in_a_page(drawn)
    for link in root.iter("a"):
        _, hash, place = link.attrib["href"].partition("#")
        link.attrib = {"href": hash + place}  # in the same tab
        link.set("aria-label", f"curves of {place.removeprefix(OF).removeprefix(ONLY)}")
    return ElementTree.tostring(root, encoding="unicode")


def fill_diagram(
    figure: Figure, scenario: Scenario, report: str | None = None, leads_to: str = OF
) -> Axes:
    """Fill a figure, whose size it sets, with the diagram; events that make faults are marked.

    Args:
        report: address of the page on whose curves converters and lines are links, a line on those
            of the converters at its ends; None for no links.
        leads_to: what the link of a converter has before its name: its chapter, or ``ONLY`` its
            curves among those of all.
    """
    plants, laws, nodes = converters_of(scenario)
    bars, lines = bars_of(scenario, nodes)
    faults = [event for event in scenario.events if isinstance(event, Fault)]
    top = give_rows(bars, lines)
    width = _BARS + _COLUMN * max(bar.column for bar in bars.values()) + 4.2
    figure.set_size_inches(0.72 * width, 0.72 * (_ROW * top + 0.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.2, width), ylim=(-_ROW * top + 0.55, 0.95), aspect="equal")
    axes.axis("off")
    passing = [(r, 0.0) for bar in bars.values() for r in bar.rows[: len(bar.converters)]]
    passing += [(r, min(_at(bars[a]), _at(bars[b]))) for r, a, b, *_ in lines.values()]
    spots: dict[str, tuple[float, float, float]] = {}  # of lines: y, where it begins and ends
    for name, bar in bars.items():
        x = _at(bar)
        for row, converter in zip(bar.rows, bar.converters, strict=False):
            _converter(axes, row, converter, plants[converter], laws[converter])
            _wire(axes, (_LINE, -_ROW * row), (x, -_ROW * row))
            _inductor(axes, _LINE + 0.2, -_ROW * row)
            behind = not converter and plants[converter].lcl is not None
            spots[converter] = -_ROW * row, _LINE + 1.1 if behind else _TERMINAL, x
            if report is not None:
                _area(axes, (0.0, _LINE + 1.1), -_ROW * row, f"{report}#{leads_to}{converter}")
        for row, (symbol, text, closed) in zip(bar.rows, bar.right, strict=False):
            _hang(axes, x, -_ROW * row, symbol, text, closed)
        ys = [-_ROW * row for row in bar.rows]
        ys += [-_ROW * row for row, start, end, *_ in lines.values() if name in (start, end)]
        ends = min(ys) - 0.35, max(ys) + 0.35
        axes.plot([x, x], ends, color=_INK, lw=3.5, solid_capstyle="butt", zorder=2.4)
        for row, left in passing:  # wires of others pass behind it
            if left < x and ends[0] < -_ROW * row < ends[1] and -_ROW * row not in ys:
                axes.plot([x - 0.15, x + 0.15], [-_ROW * row] * 2, color="white", lw=4, zorder=2.2)
        axes.text(x, max(ys) + 0.45, name, ha="center", fontsize=8.5, color=_INK)
    for name, (row, start, end, symbol, text, closed) in lines.items():
        (left, right), y = sorted((_at(bars[start]), _at(bars[end]))), -_ROW * row
        _wire(axes, (left, y), (right, y))
        _IN_LINE.get(symbol, _box)(axes, (left + right) / 2, y)
        _breaker(axes, left + 0.5, y, closed)
        axes.text((left + right) / 2, y - 0.5, f"{name}\n{text}", ha="center", va="top", **_SMALL)
        at_ends = [c for c, node in nodes.items() if node in (start, end)]
        if report is not None and at_ends:
            _area(axes, (left + 0.1, right - 0.1), y, f"{report}#{ONLY}{','.join(at_ends)}")
        spots[name] = (y, left, right) if _at(bars[start]) == left else (y, right, left)
    for event in faults:
        _fault(axes, scenario, event, bars, spots)
    return axes


def _area(axes: Axes, x: tuple[float, float], y: float, url: str) -> None:
    """A link as large as what is drawn along a row."""
    axes.add_patch(
        Rectangle((x[0], y - 1.0), x[1] - x[0], 1.6, fc="none", ec="none", url=url, zorder=5)
    )


_SMALL: dict[str, Any] = {"fontsize": 7.5, "color": _GREY, "linespacing": 1.25}


def _at(bar: Bar) -> float:
    return _BARS + _COLUMN * bar.column


def _wire(axes: Axes, *points: tuple[float, float], colour: str = _INK) -> None:
    axes.plot(*zip(*points, strict=True), color=colour, lw=1.1, solid_capstyle="round")


def _inductor(axes: Axes, x: float, y: float) -> None:
    """Four humps over 0.8, in place of the wire below them."""
    axes.add_patch(Rectangle((x, y - 0.05), 0.8, 0.1, fc="white", ec="none", zorder=2.5))
    for k in range(4):
        axes.add_patch(Arc((x + 0.1 + 0.2 * k, y), 0.2, 0.26, theta1=0, theta2=180, ec=_INK,
                           lw=1.1, zorder=3))  # fmt: skip


def _windings(axes: Axes, x: float, y: float) -> None:
    """Two circles that overlap, in place of the wire between them."""
    for side in (-0.13, 0.13):
        axes.add_patch(Circle((x + side, y), 0.24, fc="white", ec="none", zorder=2.5))
    for side in (-0.13, 0.13):
        axes.add_patch(Circle((x + side, y), 0.24, fc="none", ec=_INK, lw=1.1, zorder=3))


def _capacitor(axes: Axes, x: float, y: float) -> None:
    """From a wire down to ground."""
    _wire(axes, (x, y), (x, y - 0.3))
    for k in (0.3, 0.4):
        _wire(axes, (x - 0.18, y - k), (x + 0.18, y - k))
    _wire(axes, (x, y - 0.4), (x, y - 0.6))
    for k, half in enumerate((0.16, 0.1, 0.04)):
        _wire(axes, (x - half, y - 0.6 - 0.06 * k), (x + half, y - 0.6 - 0.06 * k))


def _box(axes: Axes, x: float, y: float) -> None:
    """A part without a symbol, 0.7 wide, in place of the wire below it."""
    axes.add_patch(Rectangle((x - 0.35, y - 0.25), 0.7, 0.5, fc="white", ec=_INK, lw=1.2, zorder=3))


def _arrow(axes: Axes, x: float, y: float) -> None:
    """Of a load, down from the end of a wire."""
    style = {"arrowstyle": "-|>", "color": _INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (x, y - 0.55), (x, y), arrowprops=style)


def _breaker(axes: Axes, x: float, y: float, closed: bool) -> None:
    """A square, filled while it is closed, as IEEE Std 315 has breakers of single-line diagrams."""
    axes.add_patch(
        Rectangle((x - 0.11, y - 0.11), 0.22, 0.22, fc=_INK if closed else "white", ec=_INK, lw=1.1,
                  zorder=3)
    )  # fmt: skip


def _converter(axes: Axes, row: int, name: str, plant: Plant, law: str) -> None:
    """DC source, bridge, filter and terminal, with what they are."""
    y = -_ROW * row
    parameters = load_converter(plant.converter)
    pu = parameters.pu(plant.real_factors())
    axes.add_patch(Circle((0.25, y), 0.25, fc="white", ec=_INK, lw=1.1))
    axes.text(0.25, y, "DC", ha="center", va="center", fontsize=6.5, color=_INK)
    _wire(axes, (0.5, y), (1.4, y))
    _capacitor(axes, 0.95, y)
    axes.add_patch(Rectangle((1.4, y - 0.35), 0.7, 0.7, fc="white", ec=_INK, lw=1.2))
    _wire(axes, (1.4, y - 0.35), (2.1, y + 0.35))
    axes.text(1.56, y + 0.17, "=", ha="center", va="center", fontsize=9, color=_INK)
    axes.text(1.93, y - 0.19, "~", ha="center", va="center", fontsize=11, color=_INK)
    _wire(axes, (2.1, y), (_LINE, y))
    _inductor(axes, 2.5, y)
    _capacitor(axes, _TERMINAL, y)
    axes.plot([_TERMINAL], [y], "o", ms=3.5, color=_INK)
    title = f"{name}: {law}" if name else law
    axes.text(0.0, y + 0.47, f"{title}, {parameters.S_n / 1e3:g} kVA", fontsize=8.5, color=_INK)
    second, line = plant.lcl, f"$L_g$ {pu['L_g']:.3g}\n$R_g$ {pu['R_g']:.2g}"
    if second is not None:
        own = f"$L_2$ {second.L:.3g}\n$R_2$ {second.R:.2g}"
        line = own if name else f"{own}\n{line}"
    if not name:  # alone at its grid
        line += f"\nSCR {1 / abs(complex(pu['R_g'], pu['L_g'])):.3g}"
    for x, text in (
        (0.95, f"$C_{{dc}}$ {pu['C_dc']:.4g}"),
        (2.9, f"$L_f$ {pu['L_f']:.3g}\n$R_f$ {pu['R_f']:.2g}"),
        (_TERMINAL, f"$C_f$ {pu['C_f']:.3g}"),
        (_LINE + 0.6, line),
    ):
        below = 0.78 if x in (0.95, _TERMINAL) else 0.15
        axes.text(x, y - below, text, ha="center", va="top", **_SMALL)


#: symbols of what lies between two nodes, in the middle of the wire
_IN_LINE: dict[str, Callable[[Axes, float, float], None]] = {
    "inductor": lambda axes, x, y: _inductor(axes, x - 0.4, y), "windings": _windings,
}  # fmt: skip
#: of what ends at one, at the end of the wire; any other text is that of a source in its circle
_AT_END: dict[str, Callable[[Axes, float, float], None]] = {
    "load": _arrow, "capacitor": _capacitor, "box": lambda axes, x, y: _box(axes, x + 0.35, y),
}  # fmt: skip


def _hang(axes: Axes, x: float, y: float, symbol: str, text: str, closed: bool) -> None:
    """What hangs on the right of a bar, with its breaker; a bank of capacitors has none."""
    _wire(axes, (x, y), (x + 1.2, y))
    if symbol != "capacitor":
        _breaker(axes, x + 0.5, y, closed)
    if symbol in _AT_END:
        _AT_END[symbol](axes, x + 1.2, y)
    else:
        axes.add_patch(Circle((x + 1.5, y), 0.3, fc="white", ec=_INK, lw=1.2))
        size = 13 if symbol == "~" else 8
        axes.text(x + 1.5, y - 0.02, symbol, ha="center", va="center", fontsize=size, color=_INK)
    place = 1.5 if symbol in ("load", "capacitor") else 1.95
    axes.text(x + place, y, text, va="center", **_SMALL)


def _fault(
    axes: Axes,
    scenario: Scenario,
    event: Fault,
    bars: Mapping[str, Bar],
    spots: Mapping[str, tuple[float, float, float]],
) -> None:
    """A flash where the event puts its fault."""
    if event.node is not None:
        x, y = _at(bars[event.node]), -_ROW * bars[event.node].rows[0]
    else:
        y, start, end = spots[event.line if event.line is not None else next(iter(spots))]
        x = start + (event.position or 0.0) * (end - start)
    flash: Sequence[tuple[float, float]] = [(0.0, 0.0), (0.16, 0.3), (0.02, 0.3), (0.2, 0.62)]
    _wire(axes, *((x + a, y + b) for a, b in flash), colour=_RED)
    axes.plot([x], [y], "v", ms=5, color=_RED, zorder=4)
    t = event.at(scenario.T_s) * scenario.T_s
    axes.text(x + 0.26, y + 0.5, f"{event.what}, {t:g} s", fontsize=7.5, color=_RED)
