"""The DC link, Eq. (8), along a piece of time: RK4 under the power that the bridge draws."""

from __future__ import annotations

from typing import Any

from gfm_plant.model import V_DC
from gfm_runtime.compiled import compiled, inlined


@inlined
def advance_dc_link(r: Any, s: Any, half_h: float) -> tuple[float, float]:
    """Take v_dc and the DC source on by one piece of the period.

    The power that the bridge draws, p.u., is a parabola through its values at the beginning, the
    middle and the end, so that a link whose voltage hardly moves is integrated by Simpson's rule.

    Args:
        r, s: elements of ``par`` and ``st``.
        half_h: half the length of the piece, s.

    Returns:
        v_dc in the middle and at the end, p.u.
    """
    running = s.trip == 0
    p_0, p_1, p_2 = s.drawn[0], s.drawn[1], s.drawn[2]
    i_u = r.i_u_gain * s.u_now[0]
    i_max = r.i_max if running else 0.0
    per_C = r.omega_b / r.C_dc
    steps = r.dc_steps
    h = half_h / steps
    b, a = 4.0 * p_1 - 3.0 * p_0 - p_2, 2.0 * (p_0 + p_2) - 4.0 * p_1
    v, i, j = s.x[V_DC], s.i_reg, s.i_source
    v_middle = v
    step = 0.5 / steps  # as a part of the piece
    for n in range(2 * steps):
        if n == steps:
            v_middle = v
        t = n * step
        now = p_0 + t * (b + t * a)
        t += 0.5 * step
        half = p_0 + t * (b + t * a)
        t += 0.5 * step
        end = p_0 + t * (b + t * a)
        g = 0.5 * h
        v_1, i_1, j_1 = _slope(r, v, i, j, now, i_u, i_max, per_C)
        v_2, i_2, j_2 = _slope(r, v + g * v_1, i + g * i_1, j + g * j_1, half, i_u, i_max, per_C)
        v_3, i_3, j_3 = _slope(r, v + g * v_2, i + g * i_2, j + g * j_2, half, i_u, i_max, per_C)
        v_4, i_4, j_4 = _slope(r, v + h * v_3, i + h * i_3, j + h * j_3, end, i_u, i_max, per_C)
        v += h / 6.0 * (v_1 + 2.0 * (v_2 + v_3) + v_4)
        i += h / 6.0 * (i_1 + 2.0 * (i_2 + i_3) + i_4)
        j += h / 6.0 * (j_1 + 2.0 * (j_2 + j_3) + j_4)
    s.x[V_DC], s.i_reg, s.i_source = v, i, j
    return v_middle, v


@compiled
def _slope(
    r: Any, v: float, i: float, j: float, p: float, i_u: float, i_max: float, per_C: float
) -> tuple[float, float, float]:
    """Return d/dt of v_dc, of the integral of the source's control, and of the source's current j
    if it has a lag. Control at its limit integrates only back out of it."""
    error = 1.0 - v
    i_dc, di, dj = i_u + r.k_p * error + i, r.k_i * error, 0.0
    if i_dc > i_max:
        i_dc, di = i_max, min(di, 0.0)
    elif i_dc < -i_max:
        i_dc, di = -i_max, max(di, 0.0)
    if r.tau_dc > 0.0:
        dj = (i_dc - j) / r.tau_dc
        i_dc = j
    return per_C * (i_dc - p / v), di, dj
