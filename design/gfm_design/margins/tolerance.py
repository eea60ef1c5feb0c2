"""Ranges of each element of the circuit, and of the grid, within which the loop is stable.

Each element varies alone, and the operating point is solved for each value. A value without an
operating point counts as unstable: the converter cannot run there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.margins.delays import first_loss
from gfm_design.model.closed_loop import ClosedLoop
from gfm_design.model.linear import Mode
from gfm_plant import NoEquilibrium
from gfm_plant.parameters import ELEMENTS, Element

FLOOR, CEILING = 0.01, 100.0  # of the factor
_POINTS = 45  # from 1 to an end: a step of a tenth
_BEYOND = 1e-4  # relative distance at which the unstable mode is determined


@dataclass(frozen=True)
class End:
    """One end of a range."""

    #: over the present value; the floor or the ceiling if the loop is stable up to there
    factor: float
    #: the mode that is unstable beyond; None at the floor or ceiling, or if there is no operating
    #: point beyond
    lost: Mode | None
    bounded: bool  #: the range ends before the floor or ceiling


@dataclass(frozen=True)
class Range:
    """The loop is stable from ``low`` to ``high``."""

    low: End
    high: End


@dataclass(frozen=True)
class GridStrength:
    """The strongest and the weakest grid at constant X/R; SCR = 1/|Z_g| p.u."""

    range: Range
    now: float
    x_over_r: float

    @property
    def strongest(self) -> float:
        """SCR of the strongest stable grid."""
        return self.now / self.range.low.factor

    @property
    def weakest(self) -> float:
        """SCR of the weakest stable grid."""
        return self.now / self.range.high.factor


def element_ranges(loop: ClosedLoop) -> dict[Element, Range | None]:
    """The range of every element; None for an element whose value is 0."""
    return {
        name: element_range(loop, (name,)) if factor(loop, name) > 0.0 else None
        for name in ELEMENTS
    }


def factor(loop: ClosedLoop, element: Element) -> float:
    """Real over nominal value of an element in a loop."""
    return loop.made_of.plant.real_factors().get(element, 1.0)


def element_range(loop: ClosedLoop, names: Sequence[Element]) -> Range:
    """The range of one element, or of several together, each over its value in the loop."""
    now = {name: factor(loop, name) for name in names}

    def at(f: float) -> dict[Element, float]:
        return {name: v * f for name, v in now.items()}

    return Range(_end(loop, at, FLOOR), _end(loop, at, CEILING))


def grid_strength(loop: ClosedLoop) -> GridStrength:
    """L_g and R_g together."""
    R, X = (float(loop.made_of.par[name][0]) for name in ("R_g", "L_g"))
    return GridStrength(
        element_range(loop, ("L_g", "R_g")), 1 / np.hypot(R, X), X / R if R else np.inf
    )


def _end(loop: ClosedLoop, at: Callable[[float], Mapping[Element, float]], last: float) -> End:
    scan = np.geomspace(1.0, last, _POINTS)
    held = first_loss(lambda f: sigma(loop, at(f)), [float(f) for f in scan])
    if held is None:
        return End(last, None, False)
    beyond = held * (1 + _BEYOND if last > 1.0 else 1 - _BEYOND)
    try:
        lost = loop.changed(at(beyond)).modes()[0]
    except NoEquilibrium:
        return End(held, None, True)
    return End(held, lost, True)


def sigma(loop: ClosedLoop, factors: Mapping[Element, float]) -> float:
    """Largest sigma at these factors, 1/s; inf without an operating point."""
    try:
        return float(loop.changed(factors).sigma())
    except NoEquilibrium:
        return float(np.inf)


Matrix = NDArray[np.float64]

POINTS = 40


@dataclass(frozen=True)
class Region:
    """sigma[i, j] in 1/s at R_g[i] and L_g[j], factors of nominal; NaN: no operating point."""

    L_g: Matrix
    R_g: Matrix
    sigma: Matrix


def stable_region(
    loop: ClosedLoop, points: int = POINTS, progress: Callable[[int], None] = lambda done: None
) -> Region:
    """Map the region, ``points`` each way, evenly by ratio; ``progress`` is told the rows done."""
    factors = np.geomspace(FLOOR, CEILING, points)
    found = np.empty((points, points))
    for i, R_g in enumerate(factors):
        for j, L_g in enumerate(factors):
            found[i, j] = sigma(loop, {"L_g": float(L_g), "R_g": float(R_g)})
        progress(i + 1)
    return Region(factors, factors, np.where(np.isfinite(found), found, np.nan))
