"""A law's loop over one of its parameters: its poles, where it is stable, and on which grids."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from gfm_design.model.linear import Mode
from gfm_hil.api.design import at_short_circuit_ratios
from gfm_hil.api.law import Law, as_law
from gfm_hil.core.errors import UserError
from gfm_hil.scenario import Scenario, load_scenario
from gfm_hil.studies.workers import SILENT, Watch

Vector = NDArray[np.float64]

POINTS = 61
_DECADE = 10.0  # of a parameter without bounds: so far to both sides
_MOST = 10_000  # loops


@dataclass(frozen=True)
class _OverGain:
    law: str
    gain: str
    own: float
    values: Vector
    title: str


@dataclass(frozen=True)
class GainSweep(_OverGain):
    """The loop of a law over one of its parameters, see ``sweep``.

    Attributes:
        law, gain: name of the law, and of its parameter.
        own: the parameter's value in the law.
        values: of the parameter, shape (n,).
        title: of the scenario.
        poles: of the loop at each value, 1/s; none where it has no operating point.
        edges: values at which the loop becomes stable or unstable, ascending.
    """

    poles: tuple[NDArray[np.complex128], ...]
    edges: tuple[float, ...]

    @property
    def sigma(self) -> Vector:
        """Largest real part of the poles, 1/s, shape (n,); NaN where there are none."""
        return np.array([p.real.max() if len(p) else np.nan for p in self.poles])

    def slowest(self) -> list[Mode | None]:
        """The mode with the largest real part at each value."""
        return [
            max((Mode.of(s) for s in p if s.imag >= 0.0), key=lambda m: m.sigma, default=None)
            for p in self.poles
        ]

    def stable(self) -> list[tuple[float, float]]:
        """The ranges of the parameter within [values[0], values[-1]] in which the loop is stable,
        and has an operating point."""
        ends, sigma = [self.values[0], *self.edges, self.values[-1]], self.sigma
        ranges = []
        for low, high in pairwise(ends):
            inside = sigma[(self.values >= low) & (self.values <= high)]
            if len(inside) and np.nanmedian(inside) < 0.0:
                ranges.append((float(low), float(high)))
        return ranges

    def __repr__(self) -> str:
        ranges = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in self.stable()) or "nowhere"
        return f"<GainSweep {self.law}: stable for {self.gain} {ranges}>"


@dataclass(frozen=True)
class StabilityMap(_OverGain):
    """The loop of a law over one of its parameters and the short-circuit ratio of its grid.

    Attributes:
        law, gain, own, values, title: as for ``GainSweep``.
        scr: short-circuit ratios, shape (m,).
        sigma: largest real part of the poles, 1/s, shape (m, n); NaN without an operating point.
    """

    scr: Vector
    sigma: Vector


def sweep(
    law: str | Path | Law,
    gain: str,
    low: float | None = None,
    high: float | None = None,
    *,
    points: int = POINTS,
    on: str | Path | Scenario = "pref_step",
    converter: str | None = None,
    watch: Watch = SILENT,
) -> GainSweep:
    """The poles of a law's sampled loop over one of its parameters (a root locus), and the values
    between which it is stable, to 1e-6 of them.

    Args:
        law: name, law file or ``Law``.
        gain: a parameter of the law; what is tied to it follows.
        low, high: its range, evenly by ratio if both have one sign; by default the bounds that the
            law file declares free, or a decade to both sides of its value.
        points: values, at least 2.
        on: scenario: plant, references and T_s.
        converter: of a scenario with a network the converter that gets this law.
        watch: told the values done.

    Raises:
        UserError: a range or number that cannot be, or no such scenario.
        LawError: the law is none, has no such parameter, or cannot be at a value.
    """
    law, loop = as_law(law), load_scenario(on)
    values = _values(law, gain, low, high, points)
    poles = []
    for k, value in enumerate(values):
        poles.append(_poles(law, gain, loop, converter, value))
        watch.progress(k + 1, points, "")
    own = float(law.file.parameters[gain].value)
    one = GainSweep(law.name, gain, own, values, loop.title, tuple(poles), ())
    largest = partial(_sigma, law, gain, loop, converter)
    return replace(one, edges=_edges(values, one.sigma, largest))


def stability_map(
    law: str | Path | Law,
    gain: str,
    low: float | None = None,
    high: float | None = None,
    *,
    scr: tuple[float, float] = (1.0, 20.0),
    points: int = 31,
    on: str | Path | Scenario = "pref_step",
    watch: Watch = SILENT,
) -> StabilityMap:
    """Where the sampled loop of a law is stable over one of its parameters and the short-circuit
    ratio of its grid.

    Args:
        law, gain, low, high, on, watch: as for ``sweep``.
        scr: least and greatest short-circuit ratio, evenly by ratio.
        points: values of each.

    Raises:
        UserError, LawError: as ``sweep``; the scenario has a network.
    """
    law, scenario = as_law(law), load_scenario(on)
    if scenario.network is not None:
        raise UserError("scr: is that of one converter's grid; the scenario has a network")
    if not 0.0 < scr[0] < scr[1] < math.inf:
        raise UserError(f"scr: {scr[0]:g} to {scr[1]:g} must be above 0, finite and ascending")
    values = _values(law, gain, low, high, points)
    ratios = np.geomspace(*scr, points)
    sigma = np.empty((points, points))
    for i, one in enumerate(at_short_circuit_ratios(scenario, ratios.tolist())):
        sigma[i] = [_sigma(law, gain, one, None, value) for value in values]
        watch.progress(i + 1, points, "")
    own = float(law.file.parameters[gain].value)
    return StabilityMap(law.name, gain, own, values, scenario.title, ratios, sigma)


def _values(law: Law, gain: str, low: float | None, high: float | None, points: int) -> Vector:
    one = law.file.parameters.get(gain)
    if one is None:
        raise UserError(f"{gain}: {law.name} has the parameters {sorted(law.file.parameters)}")
    decade = sorted((one.value / _DECADE, one.value * _DECADE)) if one.value else [None, None]
    bounds = one.free or decade
    low, high = bounds[0] if low is None else low, bounds[1] if high is None else high
    if low is None or high is None:
        raise UserError(f"{gain} is 0, and the law file has no bounds for it: give its range")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UserError(f"{gain}: range {low:g} to {high:g} must be finite and ascending")
    if not 2 <= points <= _MOST:
        raise UserError(f"points = {points}: must be 2 to {_MOST}")
    return (np.geomspace if low * high > 0.0 else np.linspace)(low, high, points)


def _poles(
    law: Law, gain: str, scenario: Scenario, converter: str | None, value: float
) -> NDArray[np.complex128]:
    changed = law.with_gains(None, **{gain: float(value)})
    try:
        return changed.closed_loop(scenario, converter=converter).poles()
    except UserError:  # there is no operating point; the scenario was checked before
        return np.empty(0, complex)


def _sigma(law: Law, gain: str, scenario: Scenario, converter: str | None, value: float) -> float:
    poles = _poles(law, gain, scenario, converter, value)
    return float(poles.real.max()) if len(poles) else math.nan


def _edges(values: Vector, sigma: Vector, largest: Callable[[float], float]) -> tuple[float, ...]:
    """Where sigma changes its sign between two neighbours that both have an operating point."""
    edges = []
    for k in range(len(values) - 1):
        if sigma[k] * sigma[k + 1] < 0.0:
            edges.append(float(brentq(largest, values[k], values[k + 1], rtol=1e-6)))
    return tuple(edges)
