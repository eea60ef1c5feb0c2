"""The grid from tick to tick: ramps and sags, and the frequency of a finite grid.

A finite grid is one swing equation with one governor, on the grid's own rating:

    2 H d(omega_g)/dt = P_turbine + p_g / S - P_load - D (omega_g - 1)
    T_gov d(P_turbine)/dt = P_set - (omega_g - 1) / droop - P_turbine

where p_g is the power that the lines bring, p.u. of the network, and S the grid's rating over that
of the network. Within a tick omega_g is held at its value in the middle, extrapolated.
"""

from __future__ import annotations

from typing import Any

from gfm_plant.solution import grid_source
from gfm_runtime.compiled import compiled


@compiled
def brought(n: Any, now: Any, unit: Any) -> float:
    """Return the power that reaches the grid, p.u. of the network, when the sources' phasors are at
    ``unit``."""
    g = grid_source(n)
    v_r = now.sequence[0, 0] * unit[g, 0] - now.sequence[0, 1] * unit[g, 1]
    v_i = now.sequence[0, 0] * unit[g, 1] + now.sequence[0, 1] * unit[g, 0]
    v_r += now.sequence[1, 0] * unit[g + 1, 0] - now.sequence[1, 1] * unit[g + 1, 1]
    v_i += now.sequence[1, 0] * unit[g + 1, 1] + now.sequence[1, 1] * unit[g + 1, 0]
    i_r = i_i = 0.0
    for k in range(n.n_states):
        i_r += n.to_grid[k] * now.w[k, 0]
        i_i += n.to_grid[k] * now.w[k, 1]
    return now.V_g * (v_r * i_r + v_i * i_i)


@compiled
def settle_grid(n: Any, now: Any) -> None:
    """Put a finite grid at rest at the frequency and the power that it has."""
    off = now.omega_g - 1.0
    p_g = brought(n, now, now.unit)
    now.P_load = 1.0
    now.P_turbine = now.P_load + n.D_grid * off - p_g / n.S_grid
    now.P_set = now.P_turbine + off / n.droop_grid
    now.omega_g_slope = 0.0


@compiled
def advance_grid(n: Any, now: Any) -> None:
    """Move ramps, sags and a finite grid on by one tick."""
    T_s = n.T_s
    if n.H_grid > 0.0:
        _swing(n, now)
    else:
        now.omega_g = _towards(now.omega_g, now.omega_g_to, now.omega_g_rate * T_s)
    now.V_g = _towards(now.V_g, now.V_g_to, now.V_g_rate * T_s)
    if now.sag_left > 0.0:
        now.sag_left -= T_s
        if now.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            now.sag_left = 0.0
            now.V_g = now.V_g_to = now.V_g_after


@compiled
def _swing(n: Any, now: Any) -> None:
    """Integrate the swing equation over a tick by RK4 under the mean power of that tick."""
    h = n.T_s
    power = now.brought / (h * n.S_grid) - now.P_load
    w, P = now.omega_g - 1.0, now.P_turbine
    w_1, P_1 = _slopes(n, now, w, P, power)
    w_2, P_2 = _slopes(n, now, w + 0.5 * h * w_1, P + 0.5 * h * P_1, power)
    w_3, P_3 = _slopes(n, now, w + 0.5 * h * w_2, P + 0.5 * h * P_2, power)
    w_4, P_4 = _slopes(n, now, w + h * w_3, P + h * P_3, power)
    w += h / 6.0 * (w_1 + 2.0 * (w_2 + w_3) + w_4)
    P += h / 6.0 * (P_1 + 2.0 * (P_2 + P_3) + P_4)
    now.omega_g, now.P_turbine, now.brought = 1.0 + w, P, 0.0
    power = brought(n, now, now.unit) / n.S_grid - now.P_load
    now.omega_g_slope, _ = _slopes(n, now, w, P, power)


@compiled
def _slopes(n: Any, now: Any, w: float, P: float, power: float) -> tuple[float, float]:
    """Return d/dt of omega_g - 1 = w and of the turbines' power P."""
    return (
        (P + power - n.D_grid * w) / (2.0 * n.H_grid),
        (now.P_set - w / n.droop_grid - P) / n.T_gov,
    )


@compiled
def _towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)
