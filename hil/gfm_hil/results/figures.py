"""Figures of a run, and of several runs in common axes as in the paper: one quantity a panel."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.beside import beside
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import replacing
from gfm_hil.recording.columns import (
    HERTZ,
    I_REF,
    PHASES,
    PIECE,
    TABLE,
    ColumnLike,
    Columns,
    of_network,
    pieces,
    unit_of,
    wave,
)
from gfm_hil.recording.run import Run, bases, controlled_by, nominal_frequency
from gfm_hil.recording.timing import LATE, ROUND_TRIP, missed
from gfm_hil.recording.waveforms import NEEDS, three_phase, usual_window
from gfm_hil.results.curves import POINTS, Panel, decimated_ticks
from gfm_hil.results.look import COLOURS as COLOURS
from gfm_hil.results.look import figure_of, legend, look, own_axes, own_colour, rc, with_look
from gfm_hil.run.network_run import NetworkRun
from gfm_hil.scenario import Scenario
from gfm_hil.scenario.expectation import reason_name
from gfm_plant.components.part import FAULT

if TYPE_CHECKING:  # matplotlib takes half a second to import: the functions that draw import it
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# gaps wide enough to see an identical curve below
_STYLES = ("-", (0, (5, 4)), (0, (6, 4, 1.5, 4)), (0, (1.5, 4)))
_POINTS = 4000  # drawn a curve; each pixel column keeps its least and its largest value
_LABELS = 40  # events with a label
_BINS = 60  # of the histogram of misses
GREY = "#888888"
_NEAR = 3.0  # half a side of the complex plane: beyond it a locus is not near -1


def _decimate(t: ColumnLike, x: ColumnLike, factor: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Least and largest value of each stretch, so that no oscillation is drawn away.

    ``t`` and ``x`` are arrays or columns of a file, of which a piece is read at a time.
    """
    ticks = len(t)
    stretch = ticks // (_POINTS // 2)
    if stretch < 3:
        return t[:], x[:] * factor
    whole = ticks // stretch * stretch
    step = max(1, PIECE // stretch) * stretch
    moments, pairs = [], []
    for first in range(0, whole, step):
        last = min(first + step, whole)
        values = (x[first:last] * factor).reshape(-1, stretch)
        low, high = np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)  # past any NaN
        times = t[first:last].reshape(-1, stretch)
        falls = values[:, -1] < values[:, 0]  # a zigzag along a smooth curve would fill its dashes
        pairs.append(
            np.column_stack([np.where(falls, high, low), np.where(falls, low, high)]).ravel()
        )
        moments.append(np.column_stack([times[:, 0], times[:, stretch // 2]]).ravel())
    return (
        np.concatenate([*moments, t[whole:ticks]]),
        np.concatenate([*pairs, x[whole:ticks] * factor]),
    )


def dress(axes: Axes, title: str = "", label: str = "") -> None:
    """What every panel has: a title at the left, a faint grid, no box. In a paper the ordinate has
    a label, if there is one, in place of the title."""
    if label and look().paper:
        axes.set_ylabel(label)
    else:
        axes.set_title(title, loc="left", fontsize=rc("axes.titlesize", 9.5), color="#222222")
    axes.grid(True, color=rc("grid.color", "#e4e4e4"), lw=rc("grid.linewidth", 0.6))
    axes.set_axisbelow(True)
    axes.tick_params(axis="x", labelsize=rc("xtick.labelsize", 8.5), color=GREY)
    axes.tick_params(axis="y", labelsize=rc("ytick.labelsize", 8.5), color=GREY)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)


def dress_alone(axes: Axes, title: str) -> None:
    """``dress`` for a figure of one panel: without its title in a paper, which has captions."""
    dress(axes, "" if look().paper else title)


def draw_panel(
    axes: Axes,
    title: str,
    curves: Sequence[tuple[ColumnLike, ColumnLike, str, str]],
    factor: float = 1.0,
    styles: Sequence[Any] = _STYLES,
    label: str = "",
) -> None:
    """One quantity: curves of t [s], values to be multiplied by ``factor``, colour and label;
    ``label``: of the ordinate, see ``dress``."""
    width = rc("lines.linewidth", 1.1)
    for k, (t, x, ours, name) in enumerate(curves):
        points, style = _decimate(*_within(t, x), factor), styles[k % len(styles)]
        axes.plot(*points, color=own_colour(ours), lw=width, ls=style, label=name)
    dress(axes, title, label)
    axes.ticklabel_format(useOffset=False)
    low, high = axes.get_ylim()
    least = 1e-3 * max(abs(low), abs(high), 1e-3)  # a flat line is not blown up to noise
    if high - low < least:
        axes.set_ylim((low + high - least) / 2, (low + high + least) / 2)


def _within(t: ColumnLike, x: ColumnLike) -> tuple[ColumnLike, ColumnLike]:
    """What a plot shows of a curve if someone has asked for a part of it, to a point beyond."""
    if (ends := look().xlim) is None:
        return t, x
    first, last = np.searchsorted(t[:], ends)
    rows = slice(max(0, first - 1), last + 1)
    return t[rows], x[rows]


def symbol(name: str, unit: str | None = None) -> str:
    """Symbol and unit of a signal, see ``Signals``, as an axis shows them; ``unit``: another one
    than that of the recording."""
    row = TABLE.get(name) or TABLE.get(f"true_{name}")
    if of_network(name):
        return f"{name} [{unit_of(name)}]"
    if name == HERTZ or (row and unit == "Hz" and row.unit == "p.u. (omega_n)"):
        return "$f$ [Hz]"
    if row is None or not row.symbol:
        return name
    text = row.symbol.replace(r"\lvert", "|").replace(r"\rvert", "|")  # unknown to matplotlib
    return f"${text}$ [{unit_of(name) if unit is None else unit}]"


def _draw_columns(
    axes: Axes,
    title: str,
    name: str,
    scenario: Scenario,
    curves: Sequence[tuple[Columns, str, str, str]],
) -> float:
    """One quantity in the unit in which people read the column ``name``: curves of columns, the
    name of one of them, colour and label. Returns the factor from what is recorded."""
    shown = TABLE[name].display_unit(nominal_frequency(scenario))
    drawn = [(columns["t"], columns[n], colour, label) for columns, n, colour, label in curves]
    text = symbol(name, shown.unit)
    draw_panel(axes, f"{title} [{shown.unit}]", drawn, shown.factor, label=text)
    return shown.factor


def _mark(
    axes: Sequence[Axes], events: Sequence[dict[str, Any]], colour: str = GREY, above: int = 20
) -> None:
    """Mark every event in every panel, and label at most ``_LABELS`` of them in the first one.

    The labels stand in three rows, the lowest of which is ``above`` points above the panel; in a
    paper, whose panels have no titles, right above the legend or the panel, with symbols as the
    axes have them.
    """
    if (ends := look().xlim) is not None:
        events = [e for e in events if ends[0] <= e["t"] <= ends[1]]
    if not events:
        return
    from matplotlib.collections import LineCollection

    for a in axes:  # one artist a panel: thousands of lines take minutes to draw
        lines = LineCollection(
            [[(e["t"], 0), (e["t"], 1)] for e in events], colors=colour, linewidths=0.8,
            linestyles=[(0, (4, 3))], zorder=0, transform=a.get_xaxis_transform(),
        )  # fmt: skip
        lines.set_in_layout(False)
        a.add_collection(lines, autolim=False)
        a.update_datalim([(e["t"], 0) for e in events], updatey=False)
        a.autoscale_view(scaley=False)
    first, last = axes[0].get_xlim()
    paper = look().paper
    if paper:
        above -= 9 if axes[0].get_legend() else 17
    for k, event in enumerate(events[:: -(-len(events) // _LABELS)]):
        late = event["t"] > first + 0.6 * (last - first)  # its label would be cut at the right
        axes[0].annotate(
            _in_symbols(event["label"]) if paper else event["label"], (event["t"], 1.0),
            (-3 if late else 3, above + 10 * (k % 3)),
            xycoords=("data", "axes fraction"), textcoords="offset points",
            fontsize=rc("legend.fontsize", 8),
            ha="right" if late else "left",
            color="#444444" if colour == GREY else colour,
        )  # fmt: skip


def _in_symbols(label: str) -> str:
    """The label of an event with the symbols of the references and commands that it names."""

    def symbol_of(name: re.Match[str]) -> str:
        row = TABLE.get(f"ref_{name[0]}")
        return f"${row.symbol}$" if row else name[0]

    return re.sub(r"\b[A-Z]\w*_\w+\b", symbol_of, label)


class Magnitude:
    """The size of a vector of which two columns hold the components; only slices are read."""

    def __init__(self, d: ColumnLike, q: ColumnLike) -> None:
        self._d, self._q, self.dtype = d, q, d.dtype

    def __len__(self) -> int:
        return len(self._d)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return np.hypot(self._d[rows], self._q[rows])


def _limited_spans(t: ColumnLike, x: ColumnLike) -> list[tuple[float, float]]:
    """From when to when, s, a column of 0 and 1 is 1; read piece by piece."""
    changes, before = [], False
    for first, part in zip(range(0, len(x), PIECE), pieces(x, 0, len(x)), strict=True):
        on = np.concatenate([[before], part == 1])
        changes += (first + np.flatnonzero(on[1:] != on[:-1])).tolist()
        before = bool(on[-1])
    if before:
        changes.append(len(x) - 1)
    edges = [float(t[k : k + 1][0]) for k in changes]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _shade(axes: Axes, t: ColumnLike, x: ColumnLike) -> None:
    """Shade the times at which a column of 0 and 1 is 1; one artist."""
    spans = [(a, b - a) for a, b in _limited_spans(t, x)]
    if spans:
        shade = axes.broken_barh(
            spans, (0, 1), transform=axes.get_xaxis_transform(), color=COLOURS[4], alpha=0.3, lw=0,
            zorder=0, label="limited",
        )  # fmt: skip
        shade.set_in_layout(False)


def _legend(axes: Axes, columns: int) -> None:
    """A legend above the panel, where it covers no curve; matplotlib warns that it is slow to look
    for a free place among many points. In a paper it has as many columns as fit."""
    if look().paper:
        labels = axes.get_legend_handles_labels()[1]
        letters = figure_of([axes]).get_figwidth() * 72 / (0.55 * 7.0)
        columns = min(columns, max(1, int(letters / (max(map(len, labels), default=1) + 6))))
    legend(
        axes, loc="lower right", bbox_to_anchor=(1, 1), borderpad=0.2, borderaxespad=0,
        ncols=columns, handlelength=1.6, columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip


class Picture(NamedTuple):
    """A figure in a file, and its panels for a page, see ``panels``."""

    path: Path
    panels: list[str]


# the same bytes for the same run; text as text; curves without steps that no eye sees
_IN_A_PAGE: Any = {"svg.hashsalt": "gfmhil", "svg.fonttype": "none", "path.simplify_threshold": 0.4}
_PANEL = (4.6, 2.3)  # inches, of a panel in a page: its text is readable on a phone


def panels(figure: Figure) -> list[str]:
    """The panels of a figure as SVG elements, which a page sets side by side or in one column.

    Each has its own axis of time; titles of the whole figure are left to the page. Sizes of the
    figure are changed.
    """
    axes = figure.axes
    grid = axes[0].get_gridspec()
    assert grid is not None
    figure.set_size_inches(_PANEL[0] * grid.ncols, _PANEL[1] * grid.nrows)
    figure.suptitle("")
    for k, a in enumerate(axes):
        a.set_gid(f"panel{k}")
        if a.get_shared_x_axes().joined(a, axes[-1]):
            a.tick_params(labelbottom=True)
            a.set_xlabel(axes[-1].get_xlabel(), fontsize=9)
    root = in_a_page(as_svg(figure))
    shared = root.findall("defs")  # the paths that clip curves
    points, height = 72 / figure.dpi, 72 * figure.get_figheight()
    boxes = {a: a.get_tightbbox() for a in axes}
    found = []
    for k, (a, box) in enumerate(boxes.items()):
        drawn = root.find(f".//g[@id='panel{k}']")
        assert drawn is not None and box is not None
        del drawn.attrib["id"]  # which would be there once a figure
        below = [b for b in boxes.values() if b is not None and abs(b.x0 - box.x0) < box.width / 2]
        left = points * min(b.x0 for b in below) - 2
        width = points * max(b.x1 for b in below) + 2 - left  # the same scale for a whole column
        top = height - points * box.y1 - 2
        view = f"{left:.1f} {top:.1f} {width:.1f} {points * box.height + 4:.1f}"
        svg = ElementTree.Element("svg", {"viewBox": view, "role": "img"})
        svg.set("aria-label", a.get_title(loc="left"))
        svg.extend([*shared, drawn])
        found.append(ElementTree.tostring(svg, encoding="unicode"))
    return found


def as_svg(figure: Figure) -> bytes:
    """A figure as a file of SVG."""
    from matplotlib import rc_context

    whole = io.BytesIO()
    with rc_context(_IN_A_PAGE):
        figure.savefig(whole, format="svg", metadata={"Date": None})
    return whole.getvalue()


def in_a_page(svg: bytes) -> ElementTree.Element:
    """A file of SVG as an element of a page, which knows SVG without namespaces."""
    root = ElementTree.fromstring(svg)
    for element in root.iter():
        element.tag = element.tag.partition("}")[2]
        element.attrib = {k.rpartition("}")[2]: v for k, v in element.attrib.items()}
    for about in root.findall("metadata"):
        root.remove(about)
    return root


def headline(figure: Figure, text: str, size: float = 11) -> None:
    """The title of a whole figure, in as many lines as it needs; none in a paper, which has
    captions, and none for axes that are of somebody's figure."""
    if look().paper or look().ax:
        return
    size = rc("figure.titlesize", size)
    points = size if isinstance(size, float | int) else 12.0
    letters = int(figure.get_figwidth() * 72 / (0.58 * points))  # mean width of a letter
    figure.suptitle(textwrap.fill(text, letters), fontsize=size, x=0.01, ha="left")


def _panels(figure: Figure, rows: int, columns: int) -> list[Axes]:
    axes = own_axes(rows * columns)
    if not axes:
        shape = (rows * columns, 1) if look().paper else (rows, columns)
        axes = list(figure.subplots(*shape, sharex=True, squeeze=False).ravel())
    for a in axes[-1:] if look().paper or look().ax else axes[-columns:]:
        a.set_xlabel("t [s]", fontsize=rc("axes.labelsize", 9))
    return axes


def _figure(size: tuple[float, float]) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


def _save(figure: Figure, path: Path, few_colours: bool = False) -> None:
    """Save a figure; of many slanted curves, whose edges have many shades, 64 colours take a
    quarter of the bytes and look the same."""
    from PIL import Image  # matplotlib needs it too

    with replacing(path) as part:
        figure.set_dpi(110)
        if (engine := figure.get_layout_engine()) is not None:
            engine.execute(figure)
            figure.set_layout_engine("none")  # with one, savefig draws the figure twice
        figure.savefig(part, dpi=110, format="png")
        if few_colours:
            with Image.open(part) as picture:
                few = picture.convert("RGB").quantize(64, dither=Image.Dither.NONE)
            few.save(part, "PNG", optimize=True)


@contextmanager
def draw_run(run: Run) -> Iterator[None]:
    """Draw one run into signals.png and waveforms.png of its folder during a block, see ``beside``;
    a page shows them as ``panels_of_run`` and ``panels_of_waves``."""

    def signals_png() -> None:
        figure = _figure(SIZE)
        draw_signals(figure, run)
        _save(figure, run.file("signals.png"))

    def waveforms_png() -> None:
        figure = _figure(SIZE_WAVES)
        if draw_waveforms(figure, run):
            _save(figure, run.file("waveforms.png"), few_colours=True)

    with ExitStack() as stack:
        if "true_p" in run.columns:
            stack.enter_context(beside(signals_png))
        if run.columns.keys() >= {*NEEDS}:
            stack.enter_context(beside(waveforms_png))
        yield


SIZE = (10.5, 7.4)  # inches, of the six panels of a run
SIZE_WAVES = (10.5, 6.4)
SIZE_LAWS = (8.6, 8.2)

#: what a figure of several runs shows: title and column
SHARED = (
    ("active power p", "true_p"),
    ("frequency", "true_omega_u"),
    ("reactive power q", "true_q"),
    ("DC voltage v_dc", "true_v_dc"),
    ("voltage V", "true_V"),
    ("current |i_dq|", "true_i"),
)
PAPER = SHARED[:4]  #: as in the paper


class Quantity(NamedTuple):
    """A panel of a run: its curves by column, each with its colour and label."""

    title: str
    curves: list[tuple[str, str, str]]


def quantities(run: Run) -> tuple[list[Quantity], Columns]:
    """The six panels of a run, p, q, frequency, V, v_dc and currents, and the columns they show."""
    blue, red, green, purple, *_ = COLOURS
    signals = run.columns
    # a regulated source ignores i_u
    i_u = [("u_i_u", green, "i_u")] if run.scenario.plant.dc_source.mode == "controlled" else []
    inner = [("i_ref", purple, "|i*|")] if {*I_REF} <= signals.keys() else []
    E = "E_law" if "E_law" in signals else "u_E_u"  # with an inner stage u_E_u is e_d
    signals = {**signals, "i_ref": Magnitude(*(signals[n] for n in I_REF))} if inner else signals
    panels = [
        ("active power p", [("true_p", blue, "p"), ("ref_P_ref", GREY, "P_ref")]),
        ("reactive power q", [("true_q", blue, "q"), ("ref_Q_ref", GREY, "Q_ref")]),
        ("frequency", [("true_omega_u", blue, "converter"), ("true_omega_g", GREY, "grid")]),
        ("voltage V", [("true_V", blue, "V"), (E, red, "E_u")]),
        ("DC voltage v_dc", [("true_v_dc", blue, "v_dc")]),
        ("currents", [("true_i", blue, "|i_dq|"), ("true_i_dc", red, "i_dc"), *inner, *i_u]),
    ]
    return [Quantity(t, [c for c in curves if c[0] in signals]) for t, curves in panels], signals


def draw_signals(figure: Figure, run: Run) -> list[Axes]:
    """Fill a figure with the ``quantities`` of a run."""
    axes = _panels(figure, 3, 2)
    panels, signals = quantities(run)
    if "limited" in signals:
        _shade(axes[-1], signals["t"], signals["limited"])
    for a, (title, named) in zip(axes, panels, strict=True):
        curves = [(signals, n, colour, label) for n, colour, label in named]
        _draw_columns(a, title, named[0][0], run.scenario, curves)
        if len(curves) > 1:
            _legend(a, len(curves) + len(a.collections))
    _mark_run(figure, axes, run)
    return axes


def _panel(
    title: str,
    t: ColumnLike,
    columns: Mapping[str, ColumnLike],
    events: Sequence[tuple[float, str]],
    colours: Sequence[str],
    most: int,
    factor: float = 1.0,
    bands: Sequence[tuple[float, float]] = (),
) -> Panel:
    """Columns by label, times ``factor``, over all of t [s], at ``most`` ticks."""
    at = decimated_ticks([*columns.values()], most)
    curves = {label: _at(x, at) * factor for label, x in columns.items()}
    ends = 0.0, float(t[len(t) - 1 :][0])
    return Panel(title, _at(t, at), curves, ends, events, colours=colours, bands=bands)


def panels_of_run(run: Run, most: int = POINTS) -> Iterator[Panel]:
    """The ``quantities`` of a run for a page in which a reader can zoom, ``most`` points each."""
    panels, signals = quantities(run)
    t = signals["t"]
    limited = _limited_spans(t, signals["limited"]) if "limited" in signals else []
    for title, named in panels:
        shown = TABLE[named[0][0]].display_unit(nominal_frequency(run.scenario))
        curves = {label: signals[n] for n, _, label in named}
        yield _panel(
            f"{title} [{shown.unit}]", t, curves, _marks_of(run), [c for _, c, _ in named],
            most, shown.factor, limited if title == "currents" else (),
        )  # fmt: skip


def panels_of_waves(run: Run) -> Iterator[Panel]:
    """The panels of ``draw_waveforms`` for a page; none if nothing was recorded in the window."""
    rows, waves = _waves(run)
    t = run.columns["t"][rows]
    if not len(t):
        return
    ends = float(t[0]), float(t[-1])
    events = [(at, label) for at, label in _marks_of(run) if ends[0] <= at <= ends[1]]
    for title, phases in waves:
        curves = {name: np.asarray(x[rows], dtype=float) for name, x in phases.items()}
        yield Panel(title, np.asarray(t, dtype=float), curves, ends, events, colours=COLOURS[:3])


def panels_of_all(
    scenario: Scenario, runs: Mapping[str, Columns], events: Sequence[dict[str, Any]], most: int
) -> Iterator[Panel]:
    """The quantities ``SHARED`` of several runs for a page, a curve a run."""
    t = max((columns["t"] for columns in runs.values()), key=len)
    happened = [(float(e["t"]), str(e["label"])) for e in events]
    colours = {run: COLOURS[k % len(COLOURS)] for k, run in enumerate(runs)}
    for title, name in SHARED:
        shown = TABLE[name].display_unit(nominal_frequency(scenario))
        curves = {run: _PaddedColumn(of[name], len(t)) for run, of in runs.items() if name in of}
        if curves:
            own = [colours[run] for run in curves]
            yield _panel(f"{title} [{shown.unit}]", t, curves, happened, own, most, shown.factor)


def panels_of_network(run: NetworkRun) -> Iterator[Panel]:
    """What was recorded of a network's parts, for a page: P, Q and the size of the current of a few
    parts a panel, at the starts of lines, the speed of those that turn, what plant controllers send
    and the voltage that they see, and the phases of the fault's current."""
    columns = next(iter(run.values())).columns
    there = [name for name in run.scenario.flows if name in columns]
    parts = [n.removesuffix(".P") for n in there if n.endswith(".P") and not n.endswith(".end.P")]
    each: list[tuple[str, dict[str, ColumnLike]]] = []
    for k in range(0, len(parts), len(COLOURS)):
        group = parts[k : k + len(COLOURS)]
        for what, title in (("P", "active power P"), ("Q", "reactive power Q")):
            each.append((title, {part: columns[f"{part}.{what}"] for part in group}))
        currents = {n: Magnitude(columns[f"{n}.i_re"], columns[f"{n}.i_im"]) for n in group}
        each.append(("current |i|", {**currents}))
        speeds = {n: columns[f"{n}.omega"] for n in group if f"{n}.omega" in there}
        if speeds:
            each.append(("speed omega", speeds))
    sent = [n for n in there if n.endswith("_set")]
    for name in dict.fromkeys(n.rpartition(".")[0] for n in sent):  # of plant controllers
        of = [n for n in (*sent, f"{name}.V") if n.startswith(f"{name}.")]
        each.append((f"set-points of {name}", {n.rpartition(".")[2]: columns[n] for n in of}))
    if f"{FAULT}.i_a" in there:
        phases = {f"i_{phase}": columns[f"{FAULT}.i_{phase}"] for phase in PHASES}
        each.append(("currents of the fault", phases))
    happened = [(float(e["t"]), str(e["label"])) for e in run.events]
    for title, drawn in each:
        own = COLOURS[: len(drawn)]
        yield _panel(f"{title} [p.u.]", columns["t"], drawn, happened, own, POINTS)


class _PaddedColumn:
    """A column of a run that may have ended before the others, NaN up to their end."""

    def __init__(self, column: ColumnLike, ticks: int) -> None:
        self._column, self._ticks, self.dtype = column, ticks, np.dtype(float)

    def __len__(self) -> int:
        return self._ticks

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        first, last, _ = rows.indices(self._ticks)
        known = np.asarray(self._column[first:last], dtype=float)
        return np.pad(known, (0, last - first - len(known)), constant_values=np.nan)


def _trips(run: Run) -> list[dict[str, Any]]:
    """The trips of a run, like its events."""
    trips = run.summary.get("trips", [])
    return [{"t": trip["t"], "label": reason_name(trip["reason"])} for trip in trips]


def _marks_of(run: Run) -> list[tuple[float, str]]:
    """Events and trips of a run by their time, s."""
    marks = (*run.summary["events"], *_trips(run))
    return sorted((float(one["t"]), str(one["label"])) for one in marks)


def _at(column: ColumnLike, ticks: NDArray[np.intp]) -> NDArray[Any]:
    """Values at some ticks, ascending, of a column that is read a piece at a time."""
    cuts = np.searchsorted(ticks, range(PIECE, len(column) + PIECE, PIECE))
    parts = np.split(ticks, cuts[:-1])
    read = [column[k * PIECE : (k + 1) * PIECE][part - k * PIECE] for k, part in enumerate(parts)]
    return np.concatenate(read).astype(float)


def _mark_run(
    figure: Figure, axes: Sequence[Axes], run: Run, first: float = 0.0, last: float = np.inf
) -> None:
    """Mark events and trips from ``first`` to ``last``, s, and give the figure its title."""
    events = [e for e in run.summary["events"] if first <= e["t"] <= last]
    _mark(axes, events)
    trips = [x for x in _trips(run) if first <= x["t"] <= last]
    _mark(axes, trips, COLOURS[1], above=20 + 10 * min(3, len(events)))
    headline(figure, f"{run.scenario.title} — {controlled_by(run.summary)}")


def draw_waveforms(
    figure: Figure, run: Run, window: tuple[float, float] | None = None
) -> list[Axes]:
    """Fill a figure with v_abc, i_abc of the bridge and i_abc of the line. Raises UserError: the
    recording lacks what ``three_phase`` needs.

    Args:
        window: from when to when, s; that of the scenario if None, or the usual one.

    Returns:
        The panels; none if nothing was recorded in the window.
    """
    rows, waves = _waves(run, window)
    t = run.columns["t"][rows]
    if not len(t):
        return []
    axes = _panels(figure, 3, 1)
    for a, (title, phases) in zip(axes, waves, strict=True):
        curves = [
            (t, x[rows], colour, phase)
            for (phase, x), colour in zip(phases.items(), COLOURS, strict=False)
        ]
        draw_panel(a, title, curves, styles=("-",))
        a.set_xlim(float(t[0]), max(rows.stop - 1, rows.start) * run.scenario.T_s)
    if "limited" in run.columns:
        _shade(axes[1], t, run.columns["limited"][rows])
        if axes[1].collections:
            _legend(axes[1], len(PHASES) + 1)
    _legend(axes[0], len(PHASES))
    _mark_run(figure, axes, run, float(t[0]), float(t[-1]))
    return axes


def _waves(
    run: Run, window: tuple[float, float] | None = None
) -> tuple[slice, list[tuple[str, dict[str, ColumnLike]]]]:
    """The ticks of a window, see ``draw_waveforms``, and the columns of the phases by title."""
    base, T_s, f_n = bases(run.scenario), run.scenario.T_s, nominal_frequency(run.scenario)
    waves = three_phase(run.columns, base)
    start, stop = window or run.scenario.waveforms or usual_window(run.summary, f_n)
    rows = slice(max(0, round(start / T_s)), max(0, round(stop / T_s) + 1))
    V, A = (f"{x:.4g}" for x in (base.V_peak, base.I_peak))
    titles = {
        "v": f"capacitor voltages [p.u. of {V} V]", "i": f"bridge currents [p.u. of {A} A]",
        "i_o": "line currents [p.u.]",
    }  # fmt: skip
    return rows, [
        (title, {phase: waves[wave(name, phase, False)] for phase in PHASES})
        for name, title in titles.items()
    ]


def draw_timing(run: Run) -> Picture:
    """Draw into timing.png how long the round trips took, and when the plant had no fresh u."""
    timing, summary, T_s = run.timing, run.summary, run.scenario.T_s
    figure = _figure((10.5, 3.4))
    left, right = figure.subplots(1, 2)
    for duration, colour in ((ROUND_TRIP, COLOURS[0]), (LATE, COLOURS[1])):
        took = duration.histogram(timing, T_s)
        before = np.cumsum(took.count) - took.count
        beyond = 1 - before / max(1, len(took))
        us = np.maximum(took.ns / 1e3, 0.1)
        left.loglog(us, beyond, color=colour, lw=1.2, label=duration.meaning)
    left.axvline(T_s * 1e6, color=GREY, lw=0.8, ls=(0, (4, 3)))
    left.text(
        T_s * 1e6, 0.98, f" T_s = {T_s * 1e6:g} µs", fontsize=8, va="top", color="#444444",
        transform=left.get_xaxis_transform(),
    )  # fmt: skip
    dress(left, "share of ticks beyond a latency [µs]")
    left.legend(fontsize=8, frameon=False, loc="lower left")
    edges, counts = np.linspace(0, summary["duration_s"], _BINS + 1), np.zeros(_BINS)
    ticks = len(timing["plant_received"])
    for first in range(0, ticks, PIECE):
        missing = np.flatnonzero(missed(timing, first, first + PIECE))
        counts += np.histogram((first + missing) * T_s, edges)[0]
    right.hist(edges[:-1], edges, weights=counts, color=COLOURS[1])
    dress(right, f"ticks without a fresh u: {summary['misses']} of {summary['ticks']}")
    right.set_xlabel("t [s]", fontsize=9)
    path = run.file("timing.png")
    _save(figure, path)
    return Picture(path, panels(figure))


def draw_laws(
    figure: Figure,
    scenario: Scenario,
    runs: Mapping[str, Columns],
    events: Sequence[dict[str, Any]],
    quantities: Sequence[tuple[str, str]],
) -> list[Axes]:
    """Fill a figure with some of ``SHARED`` of several runs, four below each other, six by twos."""
    axes = _panels(figure, 4, 1) if len(quantities) == 4 else _panels(figure, 3, 2)
    whole = max(len(s["t"]) for s in runs.values())
    if all(s["t"][0:1] == 0 for s in runs.values()):  # not only a window of each run
        whole = scenario.ticks
    for a, (title, name) in zip(axes, quantities, strict=True):
        curves = [
            (columns, name, COLOURS[k % len(COLOURS)], law)
            for k, (law, columns) in enumerate(runs.items())
            if name in columns  # a recording of others need not have it
        ]
        factor = _draw_columns(a, title, name, scenario, curves)
        for columns, _, ours, _ in curves:
            t, x = columns["t"], columns[name]
            if len(t) < whole:  # this run ended early
                a.plot(t[len(t) - 1 :], x[len(t) - 1 :] * factor, "x", color=own_colour(ours))
    _legend(axes[0], min(4, len(runs)))
    _mark(axes, events)
    headline(figure, scenario.title)
    return axes


def draw_comparison(
    path: Path,
    scenario: Scenario,
    runs: Mapping[str, Columns],
    events: Sequence[dict[str, Any]],
    quantities: Sequence[tuple[str, str]] = PAPER,
) -> None:
    """Draw several runs into a file, see ``draw_laws``."""
    figure = _figure(SIZE_LAWS if len(quantities) == 4 else SIZE)
    draw_laws(figure, scenario, runs, events, quantities)
    _save(figure, path)


# Figures for a notebook, drawn with pyplot.


def pyplot_figure(size: tuple[float, float], rows: int) -> Figure:
    """An empty figure of pyplot, of a size in inches, for so many rows of panels in a paper; or
    that of the caller's axes."""
    from matplotlib import pyplot

    if look().ax:
        return figure_of(look().ax)
    return pyplot.figure(figsize=look().figure_size(size, rows), layout="constrained")


def pyplot_panels(rows: int, size: tuple[float, float], below: int = 0) -> list[Axes]:
    """Panels below each other over one axis in a figure of pyplot, of a size in inches; in a paper
    with room for so many more ``below``."""
    if axes := own_axes(rows):
        return axes
    return list(
        pyplot_figure(size, rows + below).subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    )


def complex_plane(
    title: str,
    loci: Mapping[str, NDArray[np.complex128]],
    circle: tuple[float, float, str | None],
    of: str = "",
    style: str = "-",
) -> Axes:
    """Loci by their labels in the complex plane around -1, in a figure of pyplot.

    Args:
        circle: its centre, radius and label, to be dashed.
        of: what the axes are the parts of.
    """
    (axes,) = pyplot_panels(1, (5.6, 5.6))
    for k, (label, z) in enumerate(loci.items()):
        own = own_colour(COLOURS[k % len(COLOURS)])
        width = rc("lines.linewidth", 1.1)
        axes.plot(z.real, z.imag, style, color=own, ms=2.5, lw=width, label=label)
    centre, radius, name = circle
    z = centre + radius * np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    axes.plot(z.real, z.imag, color=GREY, lw=0.7, ls=(0, (4, 3)), label=name)
    axes.plot(-1.0, 0.0, "+", color="k", ms=10, label="−1")
    axes.set(xlim=(-_NEAR, _NEAR), ylim=(-_NEAR, _NEAR), aspect="equal")
    axes.set(xlabel=f"Re {of}".rstrip(), ylabel=f"Im {of}".rstrip())
    dress_alone(axes, title)
    legend(axes, loc="upper right")
    return axes


@with_look
def plot(run: Run, *names: str, signals: Sequence[str] = ()) -> list[Axes]:
    """Draw signals over time, one a panel; without names the six panels of the report. Raises
    UserError: a signal that was not recorded."""
    if names or signals:
        return _draw_named({"": run}, [*names, *signals], run.summary["events"])
    return draw_signals(pyplot_figure(SIZE, 6), run)


def _draw_named(
    runs: Mapping[str, Run], names: Sequence[str], events: Sequence[dict[str, Any]]
) -> list[Axes]:
    """Draw signals of some runs, one a panel."""
    curves = {
        name: [
            (run.signals["t"], run.signals[name], COLOURS[k % len(COLOURS)], label or name)
            for k, (label, run) in enumerate(runs.items())
            if k == 0 or not of_network(name)  # which is in the first recording
        ]
        for name in names
    }
    figure = pyplot_figure((8.6, 2.2 * len(names)), len(names))
    axes = _panels(figure, len(names), 1)
    for a, (name, drawn) in zip(axes, curves.items(), strict=True):
        row = TABLE.get(name)
        origin = f", {row.origin}" if row is not None and name.startswith(("y_", "m_")) else ""
        draw_panel(a, symbol(name) + origin, drawn, label=symbol(name))
    if len(runs) > 1:
        _legend(axes[0], min(4, len(runs)))
    _mark(axes, events)
    return axes


@with_look
def plot_waveforms(run: Run, start: float | None = None, stop: float | None = None) -> list[Axes]:
    """Draw the three phases of the voltages and currents, as the report does. Raises UserError:
    only one of them is given, nothing was recorded between them, or the recording lacks what this
    needs.

    Args:
        start, stop: from when to when, s; the window of the report if not given.
    """
    from matplotlib import pyplot

    if (start is None) != (stop is None):
        raise UserError(f"start = {start}, stop = {stop}: give both or neither")
    window = None if start is None or stop is None else (start, stop)
    figure = pyplot_figure(SIZE_WAVES, 3)
    axes = draw_waveforms(figure, run, window)
    if not axes:
        pyplot.close(figure)
        end = run.summary["duration_s"]
        raise UserError(f"start = {start}, stop = {stop}: the recording ends at {end:g} s")
    return axes


@with_look
def plot_network(run: NetworkRun, *names: str, signals: Sequence[str] = ()) -> list[Axes]:
    """Draw signals of all converters, one a panel; p, frequency, q, v_dc, V and current without
    names. Raises UserError: as ``plot``."""
    if names or signals:
        return _draw_named(run.runs, [*names, *signals], run.events)
    return draw_laws(pyplot_figure(SIZE, 6), run.scenario, run.columns, run.events, SHARED)


@with_look
def plot_laws(runs: Mapping[str, Run], *names: str, signals: Sequence[str] = ()) -> list[Axes]:
    """Draw signals of several laws, one a panel; p, frequency, q and v_dc without names. Raises
    UserError: as ``plot``."""
    first = next(iter(runs.values()))
    events = max((one.summary["events"] for one in runs.values()), key=len)
    if names or signals:
        return _draw_named(runs, [*names, *signals], events)
    columns = {law: one.columns for law, one in runs.items()}
    return draw_laws(pyplot_figure(SIZE_LAWS, 4), first.scenario, columns, events, PAPER)
