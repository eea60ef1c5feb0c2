"""The single-line diagram of a scenario: converters, filters, lines, loads, machines and grid.

Drawn from the scenario alone, with its parameters in p.u. of each converter; those of a network's
lines, loads and capacitors are in p.u. of the first one, as in the scenario.
"""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, Rectangle

from gfm_hil.core.files import replacing
from gfm_hil.results import single_line
from gfm_hil.results.figures import as_svg, in_a_page
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.events.fault import Fault
from gfm_plant import Plant, load_converter

_INK, _GREY, _RED = "#222222", "#666666", "#b34500"
#: x of the terminal, of a converter's line and of the first busbar; from one busbar to the next
_TERMINAL, _LINE, _BARS, _COLUMN = 3.9, 4.9, 6.7, 3.4
_ROW = 1.75
#: of a narrow page: from one row to the next, from one vertical line to the next, its width, and
#: what is left of it for words, at least
_STACKED_ROW, _LANE, _NARROW, _WORDS = 1.0, 0.4, 5.1, 2.9
#: fragments of a report's address, before names: the chapter of one converter, and the curves of
#: only these converters
OF, ONLY = "of-", "only="


def draw_diagram(
    folder: Path, scenario: Scenario, report: str | None = None, leads_to: str = OF
) -> str:
    """Draw the diagram into network.svg of a run folder; returns it as elements of a page, one for
    wide screens and one for narrow ones.

    ``report`` and ``leads_to`` are as for ``fill_diagram``; the links of the elements are within
    their page.
    """
    elements = []
    for width, fill in (("wide", fill_diagram), ("narrow", fill_narrow)):
        figure = Figure()
        fill(figure, scenario, report, leads_to)
        drawn = as_svg(figure)
        if width == "wide":
            with replacing(folder / "network.svg") as part:
                part.write_bytes(drawn)
        root = in_a_page(drawn)
        root.set("class", width)
        for link in root.iter("a"):
            fragment = link.attrib["href"].partition("#")[2]
            link.attrib = {"href": f"#{fragment}"}  # without the target of a new tab
            link.set("aria-label", f"curves of {fragment.removeprefix(OF).removeprefix(ONLY)}")
        elements.append(ElementTree.tostring(root, encoding="unicode"))
    return "".join(elements)


def fill_diagram(
    figure: Figure,
    scenario: Scenario,
    report: str | None = None,
    leads_to: str = OF,
    phasors: Mapping[str, complex] = MappingProxyType({}),
) -> Axes:
    """Draw the diagram into a figure and set its size; faults of the events are marked. A mesh
    whose nodes would overlap in columns is drawn as by ``fill_narrow``.

    Args:
        report: address of the page with the curves, to which converters and lines are links, a line
            to the curves of the converters at its ends; None: no links.
        leads_to: fragment before the name of a converter: ``OF``, its chapter, or ``ONLY``, its
            curves among those of all.
        phasors: drawn beside converters and machines, by their names; at most 1 long.
    """
    plants, laws, nodes = single_line.converters_of(scenario)
    bars, lines = single_line.bars_of(scenario, nodes)
    top = single_line.assign_rows(bars, lines)
    if single_line.collide(bars, lines):
        return fill_narrow(figure, scenario, report, leads_to, phasors)
    width = _BARS + _COLUMN * max(bar.column for bar in bars.values()) + 4.2
    figure.set_size_inches(0.72 * width, 0.72 * (_ROW * top + 0.4))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.2, width), ylim=(-_ROW * top + 0.55, 0.95), aspect="equal")
    axes.axis("off")
    passing = [(r, 0.0) for bar in bars.values() for r in bar.rows[: len(bar.converters)]]
    passing += [(x.row, min(_x_of(bars[end]) for end in x.ends)) for x in lines.values()]
    spots: _Spots = {}
    for name, bar in bars.items():
        x = _x_of(bar)
        for row, converter in zip(bar.rows, bar.converters, strict=False):
            _converter(axes, row, converter, plants[converter], laws[converter])
            _wire(axes, (_LINE, -_ROW * row), (x, -_ROW * row))
            _inductor(axes, _LINE + 0.2, -_ROW * row)
            behind = not converter and plants[converter].lcl is not None
            spots[converter] = (_LINE + 1.1 if behind else _TERMINAL, -_ROW * row), (x, -_ROW * row)
            if report is not None:
                _link_area(axes, (0.0, _LINE + 1.1), -_ROW * row, f"{report}#{leads_to}{converter}")
            _phasor(axes, 1.75, -_ROW * row - 0.8, phasors.get(converter))
        for row, (symbol, text, closed) in zip(bar.rows, bar.right, strict=False):
            _shunt(axes, x, -_ROW * row, symbol, text, closed)
            _phasor(axes, x + 1.5, -_ROW * row - 0.75, phasors.get(text.partition("\n")[0]))
        ys = [-_ROW * row for row in bar.rows]
        ys += [-_ROW * line.row for line in lines.values() if name in line.ends]
        ends = min(ys) - 0.35, max(ys) + 0.35
        axes.plot([x, x], ends, color=_INK, lw=3.5, solid_capstyle="butt", zorder=2.4)
        for row, left in passing:  # wires of others pass behind it
            if left < x and ends[0] < -_ROW * row < ends[1] and -_ROW * row not in ys:
                axes.plot([x - 0.15, x + 0.15], [-_ROW * row] * 2, color="white", lw=4, zorder=2.2)
        axes.text(x, max(ys) + 0.45, name, ha="center", fontsize=8.5, color=_INK)
    for name, line in lines.items():
        start, end = (_x_of(bars[node]) for node in line.ends)
        (left, right), y = sorted((start, end)), -_ROW * line.row
        _wire(axes, (left, y), (right, y))
        _IN_LINE.get(line.symbol, _box)(axes, (left + right) / 2, y)
        _breaker(axes, left + 0.5, y, line.closed)
        label = f"{name}\n{line.text}"
        axes.text((left + right) / 2, y - 0.5, label, ha="center", va="top", **_SMALL)
        if url := _url_of(line, nodes, report):
            _link_area(axes, (left + 0.1, right - 0.1), y, url)
        spots[name] = (start, y), (end, y)
    for name, bar in bars.items():
        spots[f"node {name}"] = ((_x_of(bar), -_ROW * bar.rows[0]),) * 2
    for event in scenario.events:
        if not isinstance(event, Fault):
            continue
        x, y, text = _fault(axes, scenario, event, spots)
        axes.text(x + 0.26, y + 0.5, text, **_MARKED)
    return axes


def fill_narrow(
    figure: Figure,
    scenario: Scenario,
    report: str | None = None,
    leads_to: str = OF,
    phasors: Mapping[str, complex] = MappingProxyType({}),
) -> Axes:
    """As ``fill_diagram`` for a narrow page: nodes below each other, lines on their left, and a
    converter's filter as text. A mesh with many lines beside each other needs a wider one."""
    plants, laws, nodes = single_line.converters_of(scenario)
    bars, lines = single_line.bars_of(scenario, nodes)
    top, lanes = (
        single_line.assign_rows(bars, lines, stacked=True),
        single_line.assign_lanes(bars, lines),
    )
    x = 0.2 + _LANE * (1 + max(lanes.values(), default=-1))
    faults = [event for event in scenario.events if isinstance(event, Fault)]
    width = max(_NARROW, x + _WORDS) + 0.9 * bool(phasors)
    height = _STACKED_ROW * (top + 0.3) + 0.3 * bool(faults)  # words below the last node
    figure.set_size_inches(0.72 * width, 0.72 * height)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.75 - height, 0.75), aspect="equal")
    axes.axis("off")
    spots: _Spots = {}
    labels: dict[str, tuple[float, float]] = {}  # (x, y) of the text of a fault, by the same names
    for name, bar in bars.items():
        ys = [-_STACKED_ROW * row for row in bar.rows]
        axes.plot([x, x], [ys[0] + 0.35, ys[-1] - 0.35], color=_INK, lw=3.5, solid_capstyle="butt")
        axes.text(x - 0.03, ys[0] + 0.42, name, fontsize=8.5, color=_INK)
        spots[f"node {name}"] = ((x, ys[-1] - 0.3),) * 2
        labels[f"node {name}"] = x + 0.3, ys[-1] - 0.75  # below the arrow of a load
        for y, converter in zip(ys, bar.converters, strict=False):
            _in_words(axes, x, y, width, converter, plants[converter], laws[converter])
            spots[converter], labels[converter] = ((x + 0.35, y), (x, y)), (x + 0.3, y - 0.5)
            if report is not None:
                _link_area(axes, (x, width), y, f"{report}#{leads_to}{converter}", 0.45)
            _phasor(axes, width - 0.45, y, phasors.get(converter))
        for y, (symbol, text, closed) in zip(ys[len(bar.converters) :], bar.right, strict=False):
            _shunt(axes, x, y, symbol, _wrap_lines(text, width - x - 1.5), closed, 0.75)
            _phasor(axes, width - 0.45, y, phasors.get(text.partition("\n")[0]))
    for name, line in lines.items():
        upper, lower = sorted(bars[node].rows for node in line.ends)
        y, at = -_STACKED_ROW * line.row, x - _LANE * (1 + lanes[name])
        ends = -_STACKED_ROW * upper[-1] - 0.22, -_STACKED_ROW * lower[0] + 0.22
        for end_y in ends:
            _wire(axes, (x, end_y), (at, end_y))
        inner = [ends[0] - 0.05, ends[1] + 0.05]  # passes before the ends of others
        axes.plot([at, at], inner, color="white", lw=4, solid_capstyle="butt", zorder=2.1)
        axes.plot([at, at], ends, color=_INK, lw=1.1, solid_capstyle="round", zorder=2.2)
        _IN_LINE.get(line.symbol, _box)(axes, at, y, True)
        _breaker(axes, at, y + 0.57, line.closed)
        label = f"{name}\n{_wrap_lines(line.text, width - x - 0.25)}"
        axes.text(x + 0.25, y, label, va="center", **_SMALL)
        begin, finish = ends if bars[line.ends[0]].rows == upper else ends[::-1]
        spots[name] = (at, begin), (at, finish)
        labels[name] = x + 0.3, y - 0.45
        if url := _url_of(line, nodes, report):
            _link_area(axes, (at - 0.3, width), y, url, 0.45)
    for event in faults:
        *_, text = _fault(axes, scenario, event, spots)
        axes.text(*labels[_spot_of(event, spots)], text, **_MARKED)
    return axes


#: both ends (x, y) of the places where a fault may be, by the name of a line or "node NAME"
_Spots = dict[str, tuple[tuple[float, float], tuple[float, float]]]


def _wrap_lines(text: str, room: float) -> str:
    """The text in lines that fit into the room that is left of a narrow page."""
    letters = int(room * 0.72 * 72 / 4.3)  # mean width of a small letter, points
    unbroken = [line.replace(" ", "\xa0").replace(",\xa0", ", ") for line in text.splitlines()]
    return "\n".join(textwrap.fill(line, letters, break_long_words=False) for line in unbroken)


def _rating(S_n: float) -> str:
    return f"{S_n / 1e6:g} MVA" if S_n >= 1e6 else f"{S_n / 1e3:g} kVA"


def _in_words(
    axes: Axes, x: float, y: float, width: float, name: str, plant: Plant, law: str
) -> None:
    """A converter on the right of its node, on a narrow page."""
    parameters = load_converter(plant.converter)
    pu = parameters.pu(plant.real_factors())
    _wire(axes, (x, y), (x + 0.35, y))
    _bridge(axes, x + 0.35, y)
    elements = [_rating(parameters.S_n)]
    elements += [f"$L_f$ {pu['L_f']:.3g}", f"$C_f$ {pu['C_f']:.3g}"]
    if plant.lcl is not None:
        elements.append(f"$L_2$ {plant.lcl.L:.3g}")
    if plant.lcl is None or not name:
        elements.append(f"$L_g$ {pu['L_g']:.3g}")
    if not name:
        elements.append(f"SCR {1 / abs(complex(pu['R_g'], pu['L_g'])):.3g}")
    text = f"{name}: {law}" if name else law
    text = "\n".join(_wrap_lines(one, width - x - 1.2) for one in (text, ", ".join(elements)))
    axes.text(x + 1.2, y, text, va="center", **_SMALL | {"color": _INK})


def _url_of(
    line: single_line.DrawnLine, nodes: Mapping[str, str], report: str | None
) -> str | None:
    """The curves of the converters at the ends of a line, if there are any in a report."""
    at_ends = [converter for converter, node in nodes.items() if node in line.ends]
    return f"{report}#{ONLY}{','.join(at_ends)}" if report is not None and at_ends else None


def _link_area(axes: Axes, x: tuple[float, float], y: float, url: str, half: float = 0.8) -> None:
    """A link over the symbols of a row, from x[0] to x[1], ``half`` high on both sides."""
    low = y - half if half < 0.8 else y - 1.0
    axes.add_patch(
        Rectangle((x[0], low), x[1] - x[0], 2 * half, fc="none", ec="none", url=url, zorder=5)
    )


_MARKED: dict[str, Any] = {"fontsize": 7.5, "color": _RED}
_SMALL: dict[str, Any] = {"fontsize": 7.5, "color": _GREY, "linespacing": 1.25}


def _x_of(bar: single_line.Bar) -> float:
    return _BARS + _COLUMN * bar.column


def _wire(axes: Axes, *points: tuple[float, float], colour: str = _INK) -> None:
    axes.plot(*zip(*points, strict=True), color=colour, lw=1.1, solid_capstyle="round")


def _inductor(axes: Axes, x: float, y: float, upright: bool = False) -> None:
    """Four humps over 0.8 from x on, or around y, in place of the wire below them."""
    place, size = ((x - 0.05, y - 0.4), (0.1, 0.8)) if upright else ((x, y - 0.05), (0.8, 0.1))
    axes.add_patch(Rectangle(place, *size, fc="white", ec="none", zorder=2.5))
    for k in range(4):
        along = 0.1 + 0.2 * k
        centre = (x, y - 0.4 + along) if upright else (x + along, y)
        axes.add_patch(Arc(centre, 0.2, 0.26, angle=-90 if upright else 0, theta1=0, theta2=180,
                           ec=_INK, lw=1.1, zorder=3))  # fmt: skip


def _windings(axes: Axes, x: float, y: float, upright: bool = False) -> None:
    """Two circles that overlap, in place of the wire between them."""
    radius = 0.18 if upright else 0.24
    centres = [(x, y + side) if upright else (x + side, y) for side in (-0.13, 0.13)]
    for fill, edge, zorder in (("white", "none", 2.5), ("none", _INK, 3)):
        for centre in centres:
            axes.add_patch(Circle(centre, radius, fc=fill, ec=edge, lw=1.1, zorder=zorder))


def _capacitor(axes: Axes, x: float, y: float) -> None:
    """From a wire down to ground."""
    _wire(axes, (x, y), (x, y - 0.3))
    for k in (0.3, 0.4):
        _wire(axes, (x - 0.18, y - k), (x + 0.18, y - k))
    _wire(axes, (x, y - 0.4), (x, y - 0.6))
    for k, half in enumerate((0.16, 0.1, 0.04)):
        _wire(axes, (x - half, y - 0.6 - 0.06 * k), (x + half, y - 0.6 - 0.06 * k))


def _box(axes: Axes, x: float, y: float, upright: bool = False) -> None:
    """A part without a symbol, 0.7 long, in place of the wire below it."""
    long, wide = (0.2, 0.7) if upright else (0.7, 0.5)
    place = x - long / 2, y - wide / 2
    axes.add_patch(Rectangle(place, long, wide, fc="white", ec=_INK, lw=1.2, zorder=3))


def _bridge(axes: Axes, x: float, y: float) -> None:
    """From DC to AC, 0.7 wide."""
    axes.add_patch(Rectangle((x, y - 0.35), 0.7, 0.7, fc="white", ec=_INK, lw=1.2))
    _wire(axes, (x, y - 0.35), (x + 0.7, y + 0.35))
    axes.text(x + 0.16, y + 0.17, "=", ha="center", va="center", fontsize=9, color=_INK)
    axes.text(x + 0.53, y - 0.19, "~", ha="center", va="center", fontsize=11, color=_INK)


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
    source = "PV" if plant.dc_source.mode == "array" else "DC"
    axes.text(0.25, y, source, ha="center", va="center", fontsize=6.5, color=_INK)
    _wire(axes, (0.5, y), (1.4, y))
    _capacitor(axes, 0.95, y)
    _bridge(axes, 1.4, y)
    _wire(axes, (2.1, y), (_LINE, y))
    _inductor(axes, 2.5, y)
    _capacitor(axes, _TERMINAL, y)
    axes.plot([_TERMINAL], [y], "o", ms=3.5, color=_INK)
    title = f"{name}: {law}" if name else law
    axes.text(0.0, y + 0.47, f"{title}, {_rating(parameters.S_n)}", fontsize=8.5, color=_INK)
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
_IN_LINE: dict[str, Callable[..., None]] = {
    "inductor": lambda axes, x, y, upright=False: _inductor(
        axes, x if upright else x - 0.4, y, upright
    ),
    "windings": _windings,
}
#: of what ends at one, at the end of the wire; any other text is that of a source in its circle
_AT_END: dict[str, Callable[[Axes, float, float], None]] = {
    "load": _arrow, "capacitor": _capacitor, "box": lambda axes, x, y: _box(axes, x + 0.35, y),
}  # fmt: skip


def _shunt(
    axes: Axes, x: float, y: float, symbol: str, text: str, closed: bool, reach: float = 1.2
) -> None:
    """A shunt element on the right of a busbar, with its breaker; a bank of capacitors has none."""
    end = x + reach
    _wire(axes, (x, y), (end, y))
    if symbol != "capacitor":
        _breaker(axes, x + reach / 2.4, y, closed)
    if symbol in _AT_END:
        _AT_END[symbol](axes, end, y)
    else:
        axes.add_patch(Circle((end + 0.3, y), 0.3, fc="white", ec=_INK, lw=1.2))
        size = 13 if symbol == "~" else 8
        axes.text(end + 0.3, y - 0.02, symbol, ha="center", va="center", fontsize=size, color=_INK)
    place = 0.3 if symbol in ("load", "capacitor") else 0.75
    axes.text(end + place, y, text, va="center", **_SMALL)


def _phasor(axes: Axes, x: float, y: float, z: complex | None) -> None:
    """An arrow from the middle of a circle that stands for 1."""
    if z is None:
        return
    axes.add_patch(Circle((x, y), 0.38, fc="white", ec=_GREY, lw=0.7, ls=":", zorder=3.5))
    tip = x + 0.38 * z.real, y + 0.38 * z.imag
    style = {"arrowstyle": "-|>", "color": _RED, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, (x, y), arrowprops=style, zorder=4)


def _spot_of(event: Fault, spots: _Spots) -> str:
    """The name of the spot of a fault."""
    if event.node is not None:
        return f"node {event.node}"
    return event.line if event.line is not None else next(s for s in spots if s[:5] != "node ")


def _fault(axes: Axes, scenario: Scenario, event: Fault, spots: _Spots) -> tuple[float, float, str]:
    """A flash where the event puts its fault; returns the place and what to write there."""
    (x, y), (x_end, y_end) = spots[_spot_of(event, spots)]
    x += (event.position or 0.0) * (x_end - x)
    y += (event.position or 0.0) * (y_end - y)
    flash: Sequence[tuple[float, float]] = [(0.0, 0.0), (0.16, 0.3), (0.02, 0.3), (0.2, 0.62)]
    _wire(axes, *((x + a, y + b) for a, b in flash), colour=_RED)
    axes.plot([x], [y], "v", ms=5, color=_RED, zorder=4)
    return x, y, f"{event.what}, {event.at(scenario.T_s) * scenario.T_s:g} s"
