"""The converter of Eq. (1)-(8) with R_f: the one copy of its equations.

Everything that needs the plant takes it from here: the fixed-step emulator, SciPy's solvers in
the tests, the steady state, and linearisation by complex step. Hence no abs, min or max, and no
argument has a fixed type: float64 and complex128 both work.

All quantities are in p.u. (`gfm_plant.bases`), time is in s, angles are in rad. The order is
x = (i_d, i_q, v_d, v_q, i_od, i_oq, delta, v_dc), u = (i_u, omega_u, E_u),
y = (v_dc, p, omega_u, q, V) and d = (omega_g, V_g), as in the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import cached, compiled

N_X, N_U, N_Y = 8, 3, 5
DELTA, V_DC = 6, 7  # where the angle and the DC voltage sit in x


class Rates(NamedTuple):
    """The circuit as Eq. (1)-(8) use it: a storage element acts through omega_b over its value.

    `per_*` is in 1/s (p.u. of state per p.u. of drive and s), resistors are in p.u. of Z_b.
    """

    omega_b: float
    per_L_f: float
    R_f: float
    per_C_f: float
    per_L_g: float
    R_g: float
    per_C_dc: float


@compiled
def rates(r: Any, bridge: float) -> Rates:
    """Return the rates of `r`, one entry of `converter_par_dtype`.

    `bridge` is 1 in operation. 0 takes L_f out of the circuit: with i_d = i_q = 0 the same
    equations then describe a blocked bridge.
    """
    w = r.omega_b
    return Rates(w, bridge * w / r.L_f, r.R_f, w / r.C_f, w / r.L_g, r.R_g, w / r.C_dc)


@compiled
def circuit(
    i_d: Any, i_q: Any, v_d: Any, v_q: Any, i_od: Any, i_oq: Any, v_dc: Any,
    i_dc: Any, omega_u: Any, E_u: Any, v_gd: Any, v_gq: Any, c: Rates,
) -> tuple[Any, ...]:  # fmt: skip
    """Return d/dt of the first seven arguments, in p.u./s: Eq. (1)-(6) with R_f, and Eq. (8).

    v_gd = V_g cos(delta) and v_gq = -V_g sin(delta) are the grid voltage in the converter's
    frame; passing them instead of delta keeps trigonometry out of the emulator's inner loop.
    """
    w = c.omega_b * omega_u
    return (
        c.per_L_f * (E_u - v_d - c.R_f * i_d) + w * i_q,
        c.per_L_f * (-v_q - c.R_f * i_q) - w * i_d,
        c.per_C_f * (i_d - i_od) + w * v_q,
        c.per_C_f * (i_q - i_oq) - w * v_d,
        c.per_L_g * (v_d - v_gd - c.R_g * i_od) + w * i_oq,
        c.per_L_g * (v_q - v_gq - c.R_g * i_oq) - w * i_od,
        c.per_C_dc * (i_dc - E_u * i_d / v_dc),
    )


@compiled
def terminal(v_d: Any, v_q: Any, i_od: Any, i_oq: Any) -> tuple[Any, Any, Any]:
    """Return p, q and V at the filter capacitor in p.u., Eq. (9)-(11)."""
    p = v_d * i_od + v_q * i_oq
    q = v_q * i_od - v_d * i_oq
    V = np.sqrt(v_d * v_d + v_q * v_q)
    return p, q, V


@cached
def f(x: NDArray[Any], u: NDArray[Any], d: NDArray[Any], par: NDArray[np.void]) -> NDArray[Any]:
    """Return dx/dt, shape (8,), of the state x (8,) under u (3,) and d (2,), all of one dtype.

    The DC source is the paper's controlled current: i_dc = i_u.
    """
    delta = x[DELTA]
    c = rates(par[0], 1.0)
    v_gd, v_gq = d[1] * np.cos(delta), -d[1] * np.sin(delta)
    slope = circuit(x[0], x[1], x[2], x[3], x[4], x[5], x[V_DC], u[0], u[1], u[2], v_gd, v_gq, c)
    dx = np.empty_like(x)
    for i in range(6):
        dx[i] = slope[i]
    dx[DELTA] = c.omega_b * (u[1] - d[0])
    dx[V_DC] = slope[6]
    return dx


@cached
def g(x: NDArray[Any], u: NDArray[Any]) -> NDArray[Any]:
    """Return the outputs y, shape (5,), of x (8,) and u (3,), both of one dtype."""
    p, q, V = terminal(x[2], x[3], x[4], x[5])
    y = np.empty(N_Y, x.dtype)
    y[0], y[1], y[2], y[3], y[4] = x[V_DC], p, u[1], q, V
    return y
