"""A grid that reacts."""

from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from gfm_plant.components.part import Dynamic
from gfm_plant.components.swing import KEPT, SWING, slopes, swing, swing_at_rest
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import grid_source, read_states
from gfm_runtime.compiled import compiled


@compiled
def _power(n: Any, now: Any, unit: Any) -> float:
    """Return the power that reaches the grid, p.u. of the network, when the sources' phasors are at
    ``unit``."""
    g, w, to_grid = grid_source(n), field(now, "w"), field(n, "to_grid")
    v = now.sequence[0] * unit[g]
    v += now.sequence[1] * unit[g + 1]
    i_r = i_i = 0.0
    for k in range(n.n_states):
        i_r += to_grid[k] * w[k].real
        i_i += to_grid[k] * w[k].imag
    return now.V_g * (v.real * i_r + v.imag * i_i)


@compiled
def _bound(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Add to its energy, by Simpson's rule, at the beginning and at the end of a piece."""
    one.energy += field(n, "half_h")[part] / 3.0 * _power(n, now, field(now, "unit"))


@compiled
def _middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    if n.n_units == 0:  # beside a switched bridge w is there
        read_states(n, now, c)
    one.energy += 4.0 * field(n, "half_h")[part] / 3.0 * _power(n, now, field(now, "halfway"))


@compiled
def _tick(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    w = swing(one, n.T_s, now.omega_g - 1.0)
    now.omega_g = now.omega_g_to = 1.0 + w  # no ramp leads elsewhere
    power = _power(n, now, field(now, "unit")) / one.S - one.P_load
    now.omega_g_slope, _ = slopes(one, w, one.P_turbine, power)


@compiled
def _at_rest(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.P_load = 1.0
    swing_at_rest(one, now.omega_g - 1.0, _power(n, now, field(now, "unit")))
    now.omega_g_slope = 0.0


class FiniteGrid(Dynamic):
    """A grid that reacts: the swing equation of all its machines as one, with a governor."""

    title: ClassVar = "Grid that reacts"
    more_states: ClassVar = (
        ("omega_g", "p.u.", "its frequency, by the swing equation"),
        ("P_turbine", "p.u. of its rating", "power of its turbines, behind the governor"),
    )
    columns: ClassVar = ("true_omega_g",)
    how_many: ClassVar = "one"
    record: ClassVar = np.dtype(SWING, align=True)
    hooks: ClassVar = {
        "at_rest": _at_rest, "begin": _bound, "middle": _middle, "end": _bound, "tick": _tick,
        **KEPT,
    }  # fmt: skip

    S: Positive = Field(description="rating of the grid over that of the converter")
    H: Positive = Field(description="inertia constant, s")
    D: NonNegative = Field(0.0, description="power of the loads by frequency, p.u./p.u.")
    droop: Positive = Field(0.05, description="frequency by power of the governors, p.u./p.u.")
    T_gov: Positive = Field(0.5, description="lag of governors and turbines, s")
