"""Fixed-step RK4 over a stretch of time during which the commands are held.

The 14 values are those of the converter, the integral of the DC source, the current of the local
load and the filters of the sensors. Values that a plant does not have stay constant because their
gains are zero: integrating them costs less than a branch, and the state stays in registers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from gfm_plant.model import Rates, circuit, terminal
from gfm_runtime.compiled import compiled

Vector = tuple[Any, ...]
"""(i_d, i_q, v_d, v_q, i_od, i_oq, v_dc, i_reg, i_load_d, i_load_q, sensed v_dc, p, q, V)"""


class Held(NamedTuple):
    """What drives the plant during a stretch; p.u. unless stated."""

    i_u: float  # feed-through part of the DC current
    omega_u: float
    E_u: float
    omega_g: float
    V_g: float
    k_p: float  # PI of the regulated DC source
    k_i: float  # per s
    i_max: float
    per_L_load: float  # omega_b / L_load, 1/s
    R_load: float
    omega_s: float  # sensor bandwidth, rad/s


@compiled
def integrate(s: Vector, delta: float, steps: int, h: float, c: Rates, held: Held) -> Vector:
    """Return the Vector `s` after `steps` RK4 steps of `h` seconds from the angle `delta`.

    With omega_u and omega_g held the angle is linear in time, so Eq. (7) needs no integration
    and the grid's phasor turns by a constant rotation each half step.
    """
    turn = 0.5 * h * c.omega_b * (held.omega_u - held.omega_g)
    cos, sin = math.cos(turn), math.sin(turn)
    v_d, v_q = held.V_g * math.cos(delta), -held.V_g * math.sin(delta)
    for _ in range(steps):
        v_d_half, v_q_half = v_d * cos + v_q * sin, v_q * cos - v_d * sin
        v_d_end, v_q_end = v_d_half * cos + v_q_half * sin, v_q_half * cos - v_d_half * sin
        k1 = _slope(s, v_d, v_q, c, held)
        k2 = _slope(_along(s, 0.5 * h, k1), v_d_half, v_q_half, c, held)
        k3 = _slope(_along(s, 0.5 * h, k2), v_d_half, v_q_half, c, held)
        k4 = _slope(_along(s, h, k3), v_d_end, v_q_end, c, held)
        s = _along(_along(_along(_along(s, h / 6, k1), h / 3, k2), h / 3, k3), h / 6, k4)
        v_d, v_q = v_d_end, v_q_end
    return s


@compiled
def _slope(s: Vector, v_gd: float, v_gq: float, c: Rates, held: Held) -> Vector:
    i_d, i_q, v_d, v_q, i_od, i_oq, v_dc, i_reg, i_ld, i_lq, s_vdc, s_p, s_q, s_V = s

    # A source at its limit integrates only back out of it.
    error = 1.0 - v_dc
    i_dc = held.i_u + held.k_p * error + i_reg
    di_reg = held.k_i * error
    if i_dc > held.i_max:
        i_dc, di_reg = held.i_max, min(di_reg, 0.0)
    elif i_dc < -held.i_max:
        i_dc, di_reg = -held.i_max, max(di_reg, 0.0)

    dx = circuit(i_d, i_q, v_d, v_q, i_od, i_oq, v_dc, i_dc, held.omega_u, held.E_u, v_gd, v_gq, c)
    w = c.omega_b * held.omega_u
    di_ld = held.per_L_load * (v_gd - held.R_load * i_ld) + w * i_lq
    di_lq = held.per_L_load * (v_gq - held.R_load * i_lq) - w * i_ld

    p, q, V = terminal(v_d, v_q, i_od, i_oq)
    a = held.omega_s
    sensed = (a * (v_dc - s_vdc), a * (p - s_p), a * (q - s_q), a * (V - s_V))
    return (*dx, di_reg, di_ld, di_lq, *sensed)


@compiled
def _along(s: Vector, h: float, k: Vector) -> Vector:
    """Return s + h k, written out because compiled tuples have no comprehension."""
    return (
        s[0] + h * k[0], s[1] + h * k[1], s[2] + h * k[2], s[3] + h * k[3], s[4] + h * k[4],
        s[5] + h * k[5], s[6] + h * k[6], s[7] + h * k[7], s[8] + h * k[8], s[9] + h * k[9],
        s[10] + h * k[10], s[11] + h * k[11], s[12] + h * k[12], s[13] + h * k[13],
    )  # fmt: skip
