"""The DC link, Eq. (8), along a piece of time: by its power series under the power that the bridge
draws; and what limits its source: a battery's power and charge, the power of a PV array, and a
chopper beside it."""

import math
from typing import Any

from gfm_plant.model import V_DC
from gfm_plant.pv_array import move_irradiance
from gfm_plant.records import ACROSS, BEHIND
from gfm_runtime.compiled import compiled, inlined

_FINER = 16  # times as many steps where a series of five terms does not do
_ROUGH = 1e-6  # p.u.; a larger last term of v_dc asks for them
_1_2, _1_3, _1_4, _1_5 = 1 / 2, 1 / 3, 1 / 4, 1 / 5


@inlined
def limit_dc_source(r: Any, s: Any) -> None:
    """Set, for the period that begins, between what the source's current stays and whether the
    chopper is on, by v_dc and the state of charge at this tick, which is when their controls sample
    them."""
    v = max(s.x[V_DC], 1e-3)
    if r.energy > 0.0:
        gives = r.P_most[0] if s.soc > r.soc[1] else 0.0
        takes = r.P_most[1] if s.soc < r.soc[2] else 0.0
        s.i_most[0], s.i_most[1] = min(r.i_max, gives / v), max(-r.i_max, -takes / v)
    if r.array != 0:
        move_irradiance(r, s)
        if r.array == BEHIND:
            s.i_most[0], s.i_most[1] = min(r.i_max, s.P_array / v), 0.0
    if r.chopper[0] > 0.0:
        on = v > (r.chopper[2] if s.chopper > 0.0 else r.chopper[1])
        s.chopper = r.chopper[0] if on else 0.0


@inlined
def discharge(r: Any, s: Any, h: float, v_0: float, v_1: float, v_2: float) -> None:
    """Take from the battery what the source has given in h s, in which v_dc went from v_0 by v_1 to
    v_2: what the bridge and the chopper drew, and what has stayed in C_dc; and what its own
    resistance loses. Its open-circuit voltage is 1 p.u.: R i^2 - i + P = 0."""
    drawn = (s.drawn[0] + 4.0 * s.drawn[1] + s.drawn[2]) / 6.0
    chopped = s.chopper * (v_0 * v_0 + 4.0 * v_1 * v_1 + v_2 * v_2) / 6.0
    P = drawn + chopped + r.C_dc / (2.0 * r.omega_b * h) * (v_2 * v_2 - v_0 * v_0)
    i, R = P, r.R_battery
    if R > 0.0:
        i = (1.0 - math.sqrt(max(1.0 - 4.0 * R * P, 0.0))) / (2.0 * R)
    s.soc -= h / r.energy * i


@inlined
def advance_dc_link(r: Any, s: Any, half_h: float) -> tuple[float, float]:
    """Take v_dc and the DC source on by one piece of the period.

    The power that the bridge draws, p.u., is a parabola through its values at the beginning, the
    middle and the end, so that a link whose voltage hardly moves is integrated by Simpson's rule.
    Where the source's control reaches or leaves its limit, or v_dc falls fast, the piece is gone
    through again in finer steps.

    Args:
        r, s: elements of ``par`` and ``st``.
        half_h: half the length of the piece, s.

    Returns:
        v_dc in the middle and at the end, p.u.
    """
    if r.array == ACROSS:
        return _advance_with_array(r, s, half_h)
    return _advance(r, s, half_h, False)


@compiled
def _advance_with_array(r: Any, s: Any, half_h: float) -> tuple[float, float]:
    return _advance(r, s, half_h, True)


@inlined
def _advance(r: Any, s: Any, half_h: float, array: bool) -> tuple[float, float]:
    """``advance_dc_link``; ``array``, which the compiler knows: a PV array is in place of the
    source."""
    i_u, g, v_0 = r.i_u_gain * s.u_now[0], s.chopper, s.x[V_DC]
    i_max, i_min = (s.i_most[0], s.i_most[1]) if s.trip == 0 else (0.0, 0.0)
    steps = r.dc_steps
    # of the array: what its light gives, and its diode, whose current is -d and the terms of j
    light, I_0, per_v_T, d = 0.0, 0.0, 0.0, 0.0
    if array and s.trip == 0:
        light, I_0, per_v_T = r.I_sc * s.irradiance + r.I_0, r.I_0, 1.0 / r.v_T
    while True:
        part = 1.0 / steps
        h = 2.0 * half_h * part
        H, lag = h * r.omega_b / r.C_dc, 0.0
        if r.tau_dc > 0.0:
            lag = h / r.tau_dc
        # p = d_0 + b n + a n^2 at step n
        d_0, d_1, d_2 = s.drawn[0], s.drawn[1], s.drawn[2]
        b, a = (4.0 * d_1 - 3.0 * d_0 - d_2) * part, (2.0 * (d_0 + d_2) - 4.0 * d_1) * part * part
        v, i, j = s.x[V_DC], s.i_reg, s.i_source
        v_middle, good = v, True
        for n in range(steps):
            limit = _limit(r, v, i, i_u, i_max, i_min)
            K, k_p, free, t_0 = h * r.k_i, r.k_p, 1.0, i_u + r.k_p * (1.0 - v) + i
            if limit != 0.0:
                k_p, free, t_0 = 0.0, 0.0, i_max if limit > 0.0 else i_min
                if limit * (1.0 - v) > 0.0:  # it integrates only back out of its limit
                    K = 0.0
            # the terms of v = v_dc, of the source's integral i, of the current j that it gives and
            # t that its control asks for, and of p / v
            per_v = 1.0 / v
            j_0 = t_0 if lag == 0.0 else j
            if array:
                d = -I_0 * math.exp(v * per_v_T)
                j_0 = light + d
            c_0 = (d_0 + n * (b + n * a)) * per_v
            v_1, i_1 = H * (j_0 - c_0 - g * v), K * (1.0 - v)
            t_1 = free * i_1 - k_p * v_1
            j_1 = t_1 if lag == 0.0 else lag * (t_0 - j_0)
            if array:
                j_1 = per_v_T * v_1 * d
            c_1 = (b + 2 * n * a - v_1 * c_0) * per_v
            v_2, i_2 = _1_2 * H * (j_1 - c_1 - g * v_1), -_1_2 * K * v_1
            t_2 = free * i_2 - k_p * v_2
            j_2 = t_2 if lag == 0.0 else _1_2 * lag * (t_1 - j_1)
            if array:
                j_2 = _1_2 * per_v_T * (v_1 * j_1 + 2.0 * v_2 * d)
            c_2 = (a - v_1 * c_1 - v_2 * c_0) * per_v
            v_3, i_3 = _1_3 * H * (j_2 - c_2 - g * v_2), -_1_3 * K * v_2
            t_3 = free * i_3 - k_p * v_3
            j_3 = t_3 if lag == 0.0 else _1_3 * lag * (t_2 - j_2)
            if array:
                j_3 = _1_3 * per_v_T * (v_1 * j_2 + 2.0 * v_2 * j_1 + 3.0 * v_3 * d)
            c_3 = -(v_1 * c_2 + v_2 * c_1 + v_3 * c_0) * per_v
            v_4, i_4 = _1_4 * H * (j_3 - c_3 - g * v_3), -_1_4 * K * v_3
            t_4 = free * i_4 - k_p * v_4
            j_4 = t_4 if lag == 0.0 else _1_4 * lag * (t_3 - j_3)
            if array:
                j_4 = v_1 * j_3 + 2.0 * v_2 * j_2 + 3.0 * v_3 * j_1 + 4.0 * v_4 * d
                j_4 *= _1_4 * per_v_T
            c_4 = -(v_1 * c_3 + v_2 * c_2 + v_3 * c_1 + v_4 * c_0) * per_v
            v_5, i_5 = _1_5 * H * (j_4 - c_4 - g * v_4), -_1_5 * K * v_4
            j_5 = _1_5 * lag * (t_4 - j_4)
            if 2 * n == steps:
                v_middle = v
            elif 2 * n + 1 == steps:
                v_middle = v + (v_1 + (v_2 + (v_3 + (v_4 + v_5 / 2) / 2) / 2) / 2) / 2
            v += v_1 + (v_2 + (v_3 + (v_4 + v_5)))
            i += i_1 + (i_2 + (i_3 + (i_4 + i_5)))
            if lag > 0.0:
                j += j_1 + (j_2 + (j_3 + (j_4 + j_5)))
            good = good and abs(v_5) <= _ROUGH and _limit(r, v, i, i_u, i_max, i_min) == limit
        if good or steps > r.dc_steps:
            break
        steps *= _FINER
    s.x[V_DC], s.i_reg, s.i_source = v, i, j
    if r.energy > 0.0:
        discharge(r, s, 2.0 * half_h, v_0, v_middle, v)
    return v_middle, v


@compiled
def _limit(r: Any, v: float, i: float, i_u: float, i_max: float, i_min: float) -> float:
    """Return 1 or -1 where the source's control is at its upper or lower limit, else 0."""
    asked = i_u + r.k_p * (1.0 - v) + i
    return 1.0 if asked > i_max else (-1.0 if asked < i_min else 0.0)
