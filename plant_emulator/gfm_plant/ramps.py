"""The grid and the machines from tick to tick: ramps and sags, swing equations and governors.

A finite grid is one swing equation with one governor, on the grid's own rating:

    2 H d(omega_g)/dt = P_turbine + p_g / S - P_load - D (omega_g - 1)
    T_gov d(P_turbine)/dt = P_set - (omega_g - 1) / droop - P_turbine

where p_g is the power that the lines bring, p.u. of the network, and S the grid's rating over that
of the network. A machine has the same equations without a load, and the power that it gives in
place of -p_g: the classical model, a constant voltage behind a reactance. Within a tick omega is
held at its value in the middle, extrapolated.
"""

from __future__ import annotations

from typing import Any

from gfm_plant.solution import grid_source, machine_source
from gfm_runtime.compiled import compiled


@compiled
def grid_power(n: Any, now: Any, unit: Any) -> float:
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
def machine_power(n: Any, now: Any, j: int, unit: Any) -> float:
    """Return the power that machine j gives, p.u. of the network, when the sources' phasors are at
    ``unit``."""
    k, i = machine_source(n, j), n.current_at[j]
    return n.E[j] * (unit[k, 0] * now.w[i, 0] + unit[k, 1] * now.w[i, 1])


@compiled
def settle(n: Any, now: Any) -> None:
    """Put a finite grid and the machines at rest at the frequency and power that they have."""
    if n.H[0] > 0.0:
        now.P_load[0] = 1.0
        _settle(n, now, 0, now.omega_g - 1.0, grid_power(n, now, now.unit))
        now.omega_g_slope = 0.0
    for j in range(1, n.n_machines + 1):
        _settle(n, now, j, now.omega[j] - 1.0, -machine_power(n, now, j, now.unit))
        now.slope[j] = 0.0


@compiled
def _settle(n: Any, now: Any, j: int, off: float, power: float) -> None:
    """Set turbines and governors so that nothing moves at a power that comes, p.u."""
    now.P_turbine[j] = now.P_load[j] + n.D[j] * off - power / n.S[j]
    now.P_set[j] = now.P_turbine[j] + off / n.droop[j]


@compiled
def advance_grid(n: Any, now: Any) -> None:
    """Move ramps, sags, a finite grid and machines on by one tick."""
    T_s = n.T_s
    for j in range(1, n.n_machines + 1):
        w = _swing(n, now, j, now.omega[j] - 1.0)
        now.omega[j] = 1.0 + w
        power = -machine_power(n, now, j, now.unit) / n.S[j]
        now.slope[j], _ = _slopes(n, now, j, w, now.P_turbine[j], power)
    if n.reference > 0:
        now.omega_g, now.omega_g_slope = now.omega[n.reference], now.slope[n.reference]
    if n.H[0] > 0.0:
        w = _swing(n, now, 0, now.omega_g - 1.0)
        now.omega_g = 1.0 + w
        power = grid_power(n, now, now.unit) / n.S[0] - now.P_load[0]
        now.omega_g_slope, _ = _slopes(n, now, 0, w, now.P_turbine[0], power)
    elif n.reference == 0:
        now.omega_g = _towards(now.omega_g, now.omega_g_to, now.omega_g_rate * T_s)
    now.V_g = _towards(now.V_g, now.V_g_to, now.V_g_rate * T_s)
    if now.sag_left > 0.0:
        now.sag_left -= T_s
        if now.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            now.sag_left = 0.0
            now.V_g = now.V_g_to = now.V_g_after


@compiled
def _swing(n: Any, now: Any, j: int, w: float) -> float:
    """Integrate swing equation j over a tick by RK4 under the mean power of that tick, from an
    omega of 1 + w; returns the new w."""
    h = n.T_s
    power = now.energy[j] / (h * n.S[j]) - now.P_load[j]
    P = now.P_turbine[j]
    w_1, P_1 = _slopes(n, now, j, w, P, power)
    w_2, P_2 = _slopes(n, now, j, w + 0.5 * h * w_1, P + 0.5 * h * P_1, power)
    w_3, P_3 = _slopes(n, now, j, w + 0.5 * h * w_2, P + 0.5 * h * P_2, power)
    w_4, P_4 = _slopes(n, now, j, w + h * w_3, P + h * P_3, power)
    now.P_turbine[j] = P + h / 6.0 * (P_1 + 2.0 * (P_2 + P_3) + P_4)
    now.energy[j] = 0.0
    return w + h / 6.0 * (w_1 + 2.0 * (w_2 + w_3) + w_4)


@compiled
def _slopes(n: Any, now: Any, j: int, w: float, P: float, power: float) -> tuple[float, float]:
    """Return d/dt of omega - 1 = w and of the turbines' power P."""
    return (
        (P + power - n.D[j] * w) / (2.0 * n.H[j]),
        (now.P_set[j] - w / n.droop[j] - P) / n.T_gov[j],
    )


@compiled
def _towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)
