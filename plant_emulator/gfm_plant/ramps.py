"""The grid from tick to tick: ramps and sags, and the frequency of a finite grid.

A finite grid is one swing equation with one governor, on the grid's own rating:

    2 H d(omega_g)/dt = P_turbine + p_g / S - P_load - D (omega_g - 1)
    T_gov d(P_turbine)/dt = P_set - (omega_g - 1) / droop - P_turbine

where p_g is the power that the line brings, p.u. of the converter, and S the grid's rating over
the converter's. Within a tick omega_g is held at its value in the middle, extrapolated.
"""

from __future__ import annotations

from typing import Any

from gfm_plant.solution import GRID, I_G, I_LOAD, I_O, NEGATIVE
from gfm_runtime.compiled import compiled


@compiled
def brought(r: Any, s: Any, p_r: float, p_i: float, n_r: float, n_i: float) -> float:
    """Return the power that reaches the grid, p.u. of the converter, by the unit phasors p of its
    positive and n of its negative sequence."""
    if s.closed == 0:
        return 0.0
    v_r = s.sequence[0, 0] * p_r - s.sequence[0, 1] * p_i
    v_i = s.sequence[0, 0] * p_i + s.sequence[0, 1] * p_r
    v_r += s.sequence[1, 0] * n_r - s.sequence[1, 1] * n_i
    v_i += s.sequence[1, 0] * n_i + s.sequence[1, 1] * n_r
    k = I_G if r.fault_at > 0.0 else I_O
    return s.V_g * (v_r * (s.w[k, 0] - s.w[I_LOAD, 0]) + v_i * (s.w[k, 1] - s.w[I_LOAD, 1]))


@compiled
def brought_now(r: Any, s: Any) -> float:
    """Return the power that reaches the grid at this instant."""
    return brought(r, s, s.unit[GRID, 0], s.unit[GRID, 1], s.unit[NEGATIVE, 0], s.unit[NEGATIVE, 1])


@compiled
def settle_grid(r: Any, s: Any) -> None:
    """Put a finite grid at rest at the frequency and the power that it has."""
    off = s.omega_g - 1.0
    p_g = brought_now(r, s)
    s.P_load = 1.0
    s.P_turbine = s.P_load + r.D_grid * off - p_g / r.S_grid
    s.P_set = s.P_turbine + off / r.droop_grid
    s.omega_g_slope = 0.0


@compiled
def advance_grid(r: Any, s: Any) -> None:
    """Move ramps, sags and a finite grid on by one tick."""
    T_s = r.T_s
    if r.H_grid > 0.0:
        _swing(r, s)
    else:
        s.omega_g = _towards(s.omega_g, s.omega_g_to, s.omega_g_rate * T_s)
    s.V_g = _towards(s.V_g, s.V_g_to, s.V_g_rate * T_s)
    if s.sag_left > 0.0:
        s.sag_left -= T_s
        if s.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            s.sag_left = 0.0
            s.V_g = s.V_g_to = s.V_g_after


@compiled
def _swing(r: Any, s: Any) -> None:
    """Integrate the swing equation over a tick by RK4 under the mean power of that tick."""
    h = r.T_s
    power = s.brought / (h * r.S_grid) - s.P_load
    w, P = s.omega_g - 1.0, s.P_turbine
    w_1, P_1 = _slopes(r, s, w, P, power)
    w_2, P_2 = _slopes(r, s, w + 0.5 * h * w_1, P + 0.5 * h * P_1, power)
    w_3, P_3 = _slopes(r, s, w + 0.5 * h * w_2, P + 0.5 * h * P_2, power)
    w_4, P_4 = _slopes(r, s, w + h * w_3, P + h * P_3, power)
    w += h / 6.0 * (w_1 + 2.0 * (w_2 + w_3) + w_4)
    P += h / 6.0 * (P_1 + 2.0 * (P_2 + P_3) + P_4)
    s.omega_g, s.P_turbine, s.brought = 1.0 + w, P, 0.0
    now = brought_now(r, s) / r.S_grid - s.P_load
    s.omega_g_slope, _ = _slopes(r, s, w, P, now)


@compiled
def _slopes(r: Any, s: Any, w: float, P: float, power: float) -> tuple[float, float]:
    """Return d/dt of omega_g - 1 = w and of the turbines' power P."""
    return (
        (P + power - r.D_grid * w) / (2.0 * r.H_grid),
        (s.P_set - w / r.droop_grid - P) / r.T_gov,
    )


@compiled
def _towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)
