"""The converter of Eq. (1)-(8) with R_f: the one copy of its equations.

SciPy's solvers in the tests, operating points, and linearisation by complex step take it from here.
Hence no abs, min or max, and no argument has a fixed type: float64 and complex128 both work.

All quantities are in p.u. (`gfm_plant.bases`), time is in s, angles are in rad. The order is
x = (i_d, i_q, v_d, v_q, i_od, i_oq, delta, v_dc), u = (i_u, omega_u, E_u),
y = (v_dc, p, omega_u, q, V) and d = (omega_g, V_g), as in the paper.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.compiled import cached, compiled

N_X, N_U, N_Y = 8, 3, 5
DELTA, V_DC = 6, 7  # where the angle and the DC voltage sit in x


@compiled
def terminal(v_d: Any, v_q: Any, i_od: Any, i_oq: Any) -> tuple[Any, Any, Any]:
    """Return p, q and V at the filter capacitor in p.u., Eq. (9)-(11)."""
    p = v_d * i_od + v_q * i_oq
    q = v_q * i_od - v_d * i_oq
    V = np.sqrt(v_d * v_d + v_q * v_q)
    return p, q, V


def f(x: NDArray[Any], u: NDArray[Any], d: NDArray[Any], par: NDArray[np.void]) -> NDArray[Any]:
    """Return dx/dt, shape (8,), of the state x (8,) under u (3,) and d (2,): Eq. (1)-(8) with R_f.
    The DC source is the paper's controlled current: i_dc = i_u. Of columns in x and u, (8, n) and
    (3, n), it returns as many.
    """
    r, omega_b = par[0], par[0]["omega_b"]
    i_d, i_q, v_d, v_q, i_od, i_oq, delta, v_dc = x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7]
    i_u, omega_u, E_u, omega_g, V_g = u[0], u[1], u[2], d[0], d[1]
    v_gd, v_gq = V_g * np.cos(delta), -V_g * np.sin(delta)
    per_L_f, per_C_f, per_L_g = omega_b / r["L_f"], omega_b / r["C_f"], omega_b / r["L_g"]
    w = omega_b * omega_u
    dx = np.empty_like(x)
    dx[0] = per_L_f * (E_u - v_d - r["R_f"] * i_d) + w * i_q
    dx[1] = per_L_f * (-v_q - r["R_f"] * i_q) - w * i_d
    dx[2] = per_C_f * (i_d - i_od) + w * v_q
    dx[3] = per_C_f * (i_q - i_oq) - w * v_d
    dx[4] = per_L_g * (v_d - v_gd - r["R_g"] * i_od) + w * i_oq
    dx[5] = per_L_g * (v_q - v_gq - r["R_g"] * i_oq) - w * i_od
    dx[6] = omega_b * (omega_u - omega_g)
    dx[7] = omega_b / r["C_dc"] * (i_u - E_u * i_d / v_dc)
    return dx


#: `f` of real numbers, without columns, in a fifth of the time
compiled_f: Any = cached(f)


def g(x: NDArray[Any], u: NDArray[Any]) -> NDArray[Any]:
    """Return the outputs y, shape (5,), of x (8,) and u (3,); of columns, as many."""
    p, q, V = terminal.py_func(x[2], x[3], x[4], x[5])
    y: NDArray[Any] = np.array([x[V_DC], p, u[1], q, V])
    return y
