"""The grid simulator from tick to tick: its ramps, sags and unbalance."""

from typing import Any

from gfm_runtime.compiled import compiled


@compiled
def advance_grid(now: Any, T_s: float) -> None:
    """Move ramps and sags on by one tick."""
    now.omega_g = towards(now.omega_g, now.omega_g_to, now.omega_g_rate * T_s)
    now.V_g = towards(now.V_g, now.V_g_to, now.V_g_rate * T_s)
    if now.sag_left > 0.0:
        now.sag_left -= T_s
        if now.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            now.sag_left = 0.0
            now.V_g = now.V_g_to = now.V_g_after
    if now.unbalance_left > 0.0:
        now.unbalance_left -= T_s
        if now.unbalance_left < 0.5 * T_s:
            now.unbalance_left = 0.0
            now.sequence[0], now.sequence[1] = 1.0, 0.0


@compiled
def towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)
