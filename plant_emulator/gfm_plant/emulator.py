"""The plant from tick to tick: take u, advance by one sampling period, give the true values.

The functions are compiled and allocate nothing. `par` and `st` are the records of
`gfm_plant.records`, which `make_plant` builds; quantities are in p.u.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.grid import advance_grid
from gfm_plant.integrator import Held, Vector, integrate
from gfm_plant.model import DELTA, V_DC, rates, terminal
from gfm_plant.names import (
    BAD_COMMAND,
    DIVERGED,
)
from gfm_plant.protection import protect, trip
from gfm_plant.quantise import quantise
from gfm_plant.records import MAX_DELAY, PlantRecord
from gfm_runtime.compiled import compiled

_FAR = 1e6  # a state beyond this many p.u. has diverged


@compiled
def plant_init(
    par: PlantRecord, st: PlantRecord, x0: NDArray[np.float64], u0: NDArray[np.float64]
) -> None:
    """Put a plant fresh from `make_plant` into the equilibrium x0 (8,), u0 (3,).

    Delay line, sensor filters, DC source and local load are filled as if it had been there
    forever; see `gfm_plant.steady_state` for such points.
    """
    r, s = par[0], st[0]
    for i in range(8):
        s.x[i] = x0[i]
    for j in range(3):
        s.u_now[j] = u0[j]
        for k in range(MAX_DELAY + 2):
            s.u[k, j] = u0[j]
    p, q, V = terminal(x0[2], x0[3], x0[4], x0[5])
    s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3] = x0[V_DC], p, q, V
    if r.i_u_gain == 0.0:
        s.i_reg = u0[0] - r.k_p * (1.0 - x0[V_DC])
    if r.L_load > 0.0:
        v_g = s.V_g * complex(math.cos(x0[DELTA]), -math.sin(x0[DELTA]))
        i_load = v_g / complex(r.R_load, u0[1] * r.L_load)
        s.i_load[0], s.i_load[1] = i_load.real, i_load.imag


@compiled
def plant_advance(par: PlantRecord, st: PlantRecord, u: NDArray[np.float64]) -> None:
    """Take the command u[k] (3,) of this tick and go on to the next.

    With a delay of n samples and a fraction of one, u[k-n-1] acts for that fraction of the
    period and u[k-n] for the rest; without delay u[k] acts at once. With at least one sample of
    it u[k] need not be known before the plant goes on, see ``plant_is_delayed``.
    """
    if plant_is_delayed(par):
        plant_step(par, st)
        plant_command(par, st, u)
    else:
        plant_command(par, st, u)
        plant_step(par, st)


@compiled
def plant_is_delayed(par: PlantRecord) -> bool:
    """Whether u[k] does not act in period k, so that the plant advances before it takes u[k].

    The caller can then advance the plant while it waits for u[k].
    """
    return bool(par[0].delay > 0)


@compiled
def plant_command(par: PlantRecord, st: PlantRecord, u: NDArray[np.float64]) -> None:
    """Put u (3,) through the D/A into the delay line."""
    r, s = par[0], st[0]
    for j in range(3):
        for k in range(r.delay + 1, 0, -1):
            s.u[k, j] = s.u[k - 1, j]
        if math.isfinite(u[j]):
            s.u[0, j] = quantise(u[j], r.dac_lo[j], r.dac_hi[j], r.dac_lsb[j])
        else:
            trip(s, BAD_COMMAND, u[j])


@compiled
def plant_step(par: PlantRecord, st: PlantRecord) -> None:
    """Go on by one sampling period under the commands in the delay line."""
    r, s = par[0], st[0]
    newest = max(r.delay - 1, 0)  # place in the line: u[k] itself is not in it yet, if delayed
    x = s.x
    v = (
        x[0], x[1], x[2], x[3], x[4], x[5], x[V_DC], s.i_reg, s.i_load[0], s.i_load[1],
        s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3],
    )  # fmt: skip
    delta = x[DELTA]
    if r.steps_old > 0:
        v, delta = _stretch(r, s, v, delta, newest + 1, r.steps_old, r.h_old)
    v, delta = _stretch(r, s, v, delta, newest, r.steps_new, r.h_new)
    s.tick += 1

    size = abs(delta) / _FAR  # the angle of an island may grow without limit
    for value in v:
        size = max(size, abs(value)) if value == value else math.inf
    if size < _FAR and v[6] > 0.0:
        for i in range(6):
            x[i] = v[i]
        x[DELTA], x[V_DC] = delta, v[6]
        s.i_reg, s.i_load[0], s.i_load[1] = v[7], v[8], v[9]
        s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3] = v[10], v[11], v[12], v[13]
        protect(r, s)
    else:
        trip(s, DIVERGED, size)  # the last good state stays
    advance_grid(r, s)


@compiled
def plant_truth(par: PlantRecord, st: PlantRecord, out: NDArray[np.float64]) -> None:
    """Write the true values at this tick to out (11,), in the order of `TRUTH`."""
    r, s = par[0], st[0]
    out[0] = s.x[V_DC]
    out[1], out[3], out[4] = terminal(s.x[2], s.x[3], s.x[4], s.x[5])
    out[2] = s.u_now[1]
    out[5] = math.hypot(s.x[0], s.x[1])
    out[6] = s.x[DELTA]
    out[7] = s.omega_g
    out[8] = s.V_g
    out[9] = s.trip
    i_dc = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - s.x[V_DC]) + s.i_reg
    i_max = r.i_max if s.trip == 0 else 0.0
    out[10] = min(max(i_dc, -i_max), i_max)


@compiled
def _stretch(
    r: Any, s: Any, v: Vector, delta: float, age: int, steps: int, h: float
) -> tuple[Vector, float]:
    """Go on by `steps` of `h` seconds under the command at place `age` of the delay line."""
    running = s.trip == 0
    if running:
        for j in range(3):
            s.u_now[j] = s.u[age, j]
    else:
        s.u_now[1] = s.omega_g  # see `trip`
    i_u, omega_u, E_u = s.u_now[0], s.u_now[1], s.u_now[2]
    held = Held(
        i_u=r.i_u_gain * i_u,
        omega_u=omega_u,
        E_u=E_u,
        omega_g=s.omega_g,
        V_g=s.V_g if s.closed else 0.0,
        k_p=r.k_p,
        k_i=r.k_i,
        i_max=r.i_max if running else 0.0,
        per_L_load=r.omega_b / r.L_load if r.L_load > 0.0 else 0.0,
        R_load=r.R_load,
        omega_s=r.omega_s,
    )
    c = rates(r, 1.0 if running else 0.0)
    v = integrate(v, delta, steps, h, c, held)
    return v, delta + steps * h * r.omega_b * (omega_u - s.omega_g)
