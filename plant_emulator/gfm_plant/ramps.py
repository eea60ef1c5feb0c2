"""The ramps and sags of the grid simulator, advanced every tick."""

from __future__ import annotations

from typing import Any

from gfm_runtime.compiled import compiled


@compiled
def advance_grid(r: Any, s: Any) -> None:
    """Move ramps and sags on by one tick."""
    T_s = r.T_s
    s.omega_g = _towards(s.omega_g, s.omega_g_to, s.omega_g_rate * T_s)
    s.V_g = _towards(s.V_g, s.V_g_to, s.V_g_rate * T_s)
    if s.sag_left > 0.0:
        s.sag_left -= T_s
        if s.sag_left < 0.5 * T_s:  # half a tick of slack absorbs the rounding of the sum
            s.sag_left = 0.0
            s.V_g = s.V_g_to = s.V_g_after


@compiled
def _towards(value: float, goal: float, most: float) -> float:
    """Move `value` towards `goal` by at most `most`."""
    return min(value + most, goal) if value < goal else max(value - most, goal)
