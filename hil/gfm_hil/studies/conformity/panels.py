"""What the figures of a part show: the judged signals with windows and limits, as few points as
the eye needs, for the picture and for the page that lets a reader zoom."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.recording.columns import symbol_of, unit_of
from gfm_hil.recording.run import Run, nominal_frequency
from gfm_hil.results.curves import Panel
from gfm_hil.results.figures import COLOURS
from gfm_hil.run.cycles import cycle_means, cycle_ticks
from gfm_hil.studies.conformity.criteria.base import at_connection
from gfm_hil.studies.conformity.criteria.plot import Plot
from gfm_hil.studies.conformity.verdict import (
    CANNOT,
    CONSISTENT,
    FAIL,
    INFORMATIVE,
    LIMITED,
    PASS,
    Vector,
    Verdict,
)
from gfm_hil.studies.scan import FrequencyScan

#: of Okabe and Ito, and a grey
VERDICT_COLOURS = {
    PASS: COLOURS[2], FAIL: COLOURS[1], CANNOT: "#999999", LIMITED: COLOURS[4],
    CONSISTENT: COLOURS[3], INFORMATIVE: COLOURS[0],
}  # fmt: skip
OTHER_COLOUR = COLOURS[6]  # of any other verdict
_ALWAYS = ("p", "V", "i", "f_hz")
_TITLES = {"p": "active power p", "V": "voltage V", "i": "current", "f_hz": "frequency f"}
# Columns of a curve, each with its least and its largest value: over the whole run, and from
# before to after each event, where what is judged goes on.
_COLUMNS, _NEAR, _AROUND_S = 240, 60, (-0.02, 0.3)


@dataclass(frozen=True)
class Mark:
    """A clause in a panel."""

    number: int  # of the clause in the table of its part
    verdict: str
    words: str  # limit and window
    window: tuple[float, float]  # from when to when it is judged, s, or from what to what Hz
    lines: list[tuple[Vector, Vector]]  # its limits, shape (K,) each: abscissa and value

    @property
    def colour(self) -> str:
        """That of its verdict."""
        return VERDICT_COLOURS.get(self.verdict, OTHER_COLOUR)


class PartFigure(NamedTuple):
    """The picture of a part, and what it shows."""

    path: Path
    panels: list[Panel]


def panels_of_run(run: Run, verdicts: Sequence[Verdict]) -> list[Panel]:
    """A panel for each signal that was judged, and for power, voltage, current and frequency:
    every tick, and the one-cycle means by which most clauses are judged."""
    judged = [v.signal for v in verdicts if v.signal and v.signal != "omega_u"]
    T_s, ticks = run.scenario.T_s, run.ticks
    width = cycle_ticks(T_s, nominal_frequency(run.scenario))
    events = [float(e["t"]) for e in run.summary["events"]]
    edges = _edges(ticks, T_s, events)
    x = np.column_stack([edges, np.append(edges[1:], ticks) - 1]).ravel() * T_s
    numbered, found = [*enumerate(verdicts, 1)], []
    for name in dict.fromkeys([*_ALWAYS, *judged]):
        if name not in run.signals:  # of a recording
            continue
        unit, factor = unit_of(name) or "–", 1.0
        if unit == "rad":
            unit, factor = "°", math.degrees(1.0)
        values = factor * np.asarray(run.signals[at_connection(run, name)], np.float64)
        means = np.full(ticks, np.nan)
        inside = np.concatenate([np.empty(0), *cycle_means(values, 0, ticks, width)])
        first = round(0.5 * (width - 1))
        means[first : first + len(inside)] = inside[: ticks - first]
        found.append(
            Panel(
                f"{_TITLES.get(name, symbol_of(name))} [{unit}]", x,
                {"every tick": _thin(values, edges), "one-cycle mean": _thin(means, edges)},
                (0.0, run.scenario.duration), [(t, "") for t in events],
                _marks([(k, v) for k, v in numbered if v.signal == name], factor),
            )
        )  # fmt: skip
    return found


def panels_of_plot(plot: Plot, found: FrequencyScan, verdicts: Sequence[Verdict]) -> list[Panel]:
    """The panels of a measured plot."""
    hz, panels = found.frequency, []
    for curve in plot.curves(found):
        curves = {} if curve.model is None else {"linear model": curve.model}
        curves["measured"] = curve.measured
        marks = _marks([(k, v) for k, v in enumerate(verdicts, 1) if v.unit == curve.unit], 1.0)
        ends = float(hz[0]), float(hz[-1])
        over = "frequency of the perturbation [Hz]"
        log = (True, curve.log)
        panels.append(Panel(curve.title, hz, curves, ends, marks=marks, over=over, log=log))
    return panels


def _marks(numbered: Iterable[tuple[int, Verdict]], factor: float) -> list[Mark]:
    marks = []
    for number, v in numbered:
        lines, start, stop = list[tuple[Vector, Vector]](), v.start, v.stop
        if v.curve is not None:
            t, *limits = v.curve
            lines = [(t, factor * limit) for limit in limits]
        elif v.limited is not None:
            start, stop = min(start, v.limited[0]) if stop > start else v.limited[0], v.limited[1]
            limits = [np.full(2, factor * x) for x in (v.low, v.high) if x is not None]
            lines = [(np.array(v.limited), limit) for limit in limits]
        window = f"{v.start:g} … {v.stop:g} s" if v.stop > v.start else ""
        words = "; ".join(filter(None, [v.limit, window])) or v.verdict
        marks.append(Mark(number, v.verdict, words, (start, stop), lines))
    return marks


def _edges(ticks: int, T_s: float, events: Iterable[float]) -> NDArray[np.intp]:
    """The first tick of each column that is drawn."""
    around = np.linspace(*_AROUND_S, _NEAR)
    parts = [np.linspace(0, ticks, _COLUMNS, endpoint=False), *((t + around) / T_s for t in events)]
    found = np.unique(np.concatenate(parts).round().astype(np.intp))
    return found[(found >= 0) & (found < ticks)]


def _thin(x: Vector, edges: NDArray[np.intp]) -> Vector:
    """Least and largest value of each column, in the order in which they come."""
    low, high = np.fmin.reduceat(x, edges), np.fmax.reduceat(x, edges)
    falls = x[np.append(edges[1:], len(x)) - 1] < x[edges]
    return np.column_stack([np.where(falls, high, low), np.where(falls, low, high)]).ravel()
