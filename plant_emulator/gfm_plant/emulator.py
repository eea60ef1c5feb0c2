"""The plant from tick to tick: take u, advance by one sampling period, give the true values.

The functions are compiled and allocate nothing. `par` and `st` are the records of
`gfm_plant.records`, which `make_plant` builds; quantities are in p.u.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.dc_link import advance_dc_link
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.names import BAD_COMMAND, DIVERGED
from gfm_plant.protection import protect, trip
from gfm_plant.quantise import quantise
from gfm_plant.ramps import advance_grid, brought, brought_now, settle_grid
from gfm_plant.records import MAX_DELAY, N_COMMANDS, OPERATING, PlantRecord
from gfm_plant.solution import (
    BRIDGE,
    GRID,
    I_F,
    I_LOAD,
    I_O,
    NEGATIVE,
    V,
    circuit,
    drive,
    enter,
    half_step,
    read_states,
    state,
)
from gfm_runtime.compiled import cached, compiled

_FAR = 1e6  # a state beyond this many p.u. has diverged


@compiled
def plant_init(
    par: PlantRecord, st: PlantRecord, x0: NDArray[np.float64], u0: NDArray[np.float64]
) -> None:
    """Put a plant fresh from `make_plant` into the equilibrium x0 (8,), u0 (3,) or, with the q
    component of the bridge's voltage, (4,).

    Delay line, sensor filters, DC source and local load are filled as if it had been there
    forever; see `gfm_plant.steady_state` for such points.
    """
    r, s = par[0], st[0]
    delta = x0[DELTA]
    s.unit[GRID, 0], s.unit[GRID, 1] = 1.0, 0.0
    cos, sin = math.cos(delta), math.sin(delta)
    s.unit[BRIDGE, 0], s.unit[BRIDGE, 1] = cos, sin
    for i in range(3):
        s.w[i, 0] = x0[2 * i] * cos - x0[2 * i + 1] * sin
        s.w[i, 1] = x0[2 * i] * sin + x0[2 * i + 1] * cos
    if r.L_load > 0.0:
        i_load = s.V_g / complex(r.R_load, u0[1] * r.L_load)
        s.w[I_LOAD, 0], s.w[I_LOAD, 1] = i_load.real, i_load.imag
    enter(r, s, OPERATING)
    s.x[DELTA], s.x[V_DC] = delta, x0[V_DC]
    _write_x(s)
    for j in range(len(u0)):
        s.u_now[j] = u0[j]
        for k in range(MAX_DELAY + 2):
            s.u[k, j] = u0[j]
    p, q, v = terminal(x0[2], x0[3], x0[4], x0[5])
    s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3] = x0[V_DC], p, q, v
    if r.i_u_gain == 0.0:
        s.i_reg = u0[0] - r.k_p * (1.0 - x0[V_DC])
    s.i_source, s.E[0], s.E[1] = u0[0], s.u_now[2], s.u_now[3]
    if r.H_grid > 0.0:
        settle_grid(r, s)


@compiled
def plant_advance(par: PlantRecord, st: PlantRecord, u: NDArray[np.float64]) -> None:
    """Take the command u[k] of this tick, (3,) or (4,), and go on to the next.

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
    """Put u, (3,) or (4,), through the D/A into the delay line."""
    r, s = par[0], st[0]
    for j in range(len(u)):
        for k in range(r.delay + 1, 0, -1):
            s.u[k, j] = s.u[k - 1, j]
        if math.isfinite(u[j]):
            s.u[0, j] = quantise(u[j], r.dac_lo[j], r.dac_hi[j], r.dac_lsb[j])
        else:
            trip(r, s, BAD_COMMAND, u[j])


@compiled
def plant_step(par: PlantRecord, st: PlantRecord) -> None:
    """Go on by one sampling period under the commands in the delay line."""
    r, s = par[0], st[0]
    newest = max(r.delay - 1, 0)  # place in the line: u[k] itself is not in it yet, if delayed
    before = (
        s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source,
        s.unit[BRIDGE, 0], s.unit[BRIDGE, 1], s.unit[GRID, 0], s.unit[GRID, 1],
        s.unit[NEGATIVE, 0], s.unit[NEGATIVE, 1],
        s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3],
    )  # fmt: skip
    for i in range(r.n_states):
        s.w_before[i, 0], s.w_before[i, 1] = s.w[i, 0], s.w[i, 1]
    if r.stretch[0] > 0.0:
        _stretch(r, s, newest + 1, 0)
    _stretch(r, s, newest, 1)
    s.tick += 1

    size = abs(s.x[DELTA]) / _FAR  # the angle of an island may grow without limit
    for i in range(r.n_states):
        size = _larger(size, abs(s.w[i, 0]) + abs(s.w[i, 1]))
    for j in range(4):
        size = _larger(size, abs(s.sensed[j]))
    size = _larger(_larger(_larger(size, abs(s.x[V_DC])), abs(s.i_reg)), abs(s.i_source))
    if size < _FAR and s.x[V_DC] > 0.0:
        _write_x(s)
        protect(r, s)
    else:  # the last good state stays
        (
            s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source,
            s.unit[BRIDGE, 0], s.unit[BRIDGE, 1], s.unit[GRID, 0], s.unit[GRID, 1],
            s.unit[NEGATIVE, 0], s.unit[NEGATIVE, 1],
            s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3],
        ) = before  # fmt: skip
        for i in range(r.n_states):
            s.w[i, 0], s.w[i, 1] = s.w_before[i, 0], s.w_before[i, 1]
        trip(r, s, DIVERGED, size)
        enter(r, s, circuit(s))
    advance_grid(r, s)
    if s.unbalance_left > 0.0:
        s.unbalance_left -= r.T_s
        if s.unbalance_left < 0.5 * r.T_s:
            s.unbalance_left = s.sequence[0, 1] = s.sequence[1, 0] = s.sequence[1, 1] = 0.0
            s.sequence[0, 0] = 1.0
    if s.faulted:
        s.fault_left -= r.T_s
        if s.fault_left < 0.5 * r.T_s:
            s.faulted = 0
            enter(r, s, circuit(s))
            _write_x(s)


@compiled
def plant_truth(par: PlantRecord, st: PlantRecord, out: NDArray[np.float64]) -> None:
    """Write the true values at this tick to out (15,), in the order of `TRUTH`."""
    r, s = par[0], st[0]
    out[0] = s.x[V_DC]
    out[1], out[3], out[4] = terminal(s.x[2], s.x[3], s.x[4], s.x[5])
    out[2] = s.u_now[1]
    out[5] = math.sqrt(s.x[0] ** 2 + s.x[1] ** 2)
    out[6] = s.x[DELTA]
    out[7] = s.omega_g
    out[8] = s.V_g
    out[9] = s.trip
    if r.tau_dc > 0.0:
        out[10] = s.i_source
    else:
        i_dc = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - s.x[V_DC]) + s.i_reg
        i_max = r.i_max if s.trip == 0 else 0.0
        out[10] = min(max(i_dc, -i_max), i_max)
    out[11], out[12], out[13], out[14] = s.w[V, 0], s.w[V, 1], s.w[I_F, 0], s.w[I_F, 1]


@compiled
def _stretch(r: Any, s: Any, age: int, part: int) -> None:
    """Go on by one stretch of the period under the command at place `age` of the delay line."""
    running = s.trip == 0
    if running:
        for j in range(N_COMMANDS):
            s.u_now[j] = s.u[age, j]
    else:
        s.u_now[1] = s.omega_g + 0.5 * r.T_s * s.omega_g_slope  # see `trip`
    # the modulator divides by the v_dc that it has at the beginning of its period
    most = r.m_max * s.x[V_DC]
    s.E[0], s.E[1] = s.u_now[2], s.u_now[3]
    size = s.E[0] * s.E[0] + s.E[1] * s.E[1]
    if size > most * most:
        scale = most / math.sqrt(size)
        s.E[0] *= scale
        s.E[1] *= scale
    c = circuit(s)
    E_d, E_q = s.E[0], s.E[1]
    for _ in range(r.pieces[part]):
        if r.i_peak < math.inf and s.trip == 0:
            s.E[0], s.E[1] = _within_peak(r, s, part, E_d, E_q, most)
        _piece(r, s, c, part)


@compiled
def _within_peak(
    r: Any, s: Any, part: int, E_d: float, E_q: float, most: float
) -> tuple[float, float]:
    """Return the bridge's mean voltage over a piece, in the converter's frame.

    It is the command, unless the current of L_f would leave the limit. The hardware then blocks
    pulses, which on average gives the voltage that keeps the current at the limit, in the direction
    in which the command would have led it.
    """
    u_r, u_i = s.unit[BRIDGE, 0], s.unit[BRIDGE, 1]
    i_d, i_q = s.w[I_F, 0] * u_r + s.w[I_F, 1] * u_i, s.w[I_F, 1] * u_r - s.w[I_F, 0] * u_i
    v_d, v_q = s.w[V, 0] * u_r + s.w[V, 1] * u_i, s.w[V, 1] * u_r - s.w[V, 0] * u_i
    X = s.u_now[1] * r.L_f
    drop_d, drop_q = v_d + r.R_f * i_d - X * i_q, v_q + r.R_f * i_q + X * i_d
    reach = 2.0 * r.half_h[part] * r.omega_b / r.L_f  # p.u. of current per p.u. of voltage
    to_d, to_q = i_d + reach * (E_d - drop_d), i_q + reach * (E_q - drop_q)
    size = math.sqrt(to_d * to_d + to_q * to_q)
    if size <= r.i_peak:
        return E_d, E_q
    scale = r.i_peak / size
    E_d, E_q = drop_d + (to_d * scale - i_d) / reach, drop_q + (to_q * scale - i_q) / reach
    size = math.sqrt(E_d * E_d + E_q * E_q)
    if size > most:
        E_d, E_q = E_d * most / size, E_q * most / size
    return E_d, E_q


@compiled
def _piece(r: Any, s: Any, c: int, part: int) -> None:
    """Go on by one piece of a stretch under the command that acts."""
    omega_u, E_d, E_q = s.u_now[1], s.E[0], s.E[1]
    omega_g = s.omega_g + 0.5 * r.T_s * s.omega_g_slope  # in the middle of the tick
    for m in range(r.n_modes[c]):
        s.forced[m, 0] = s.forced[m, 1] = s.forced[m, 2] = s.forced[m, 3] = 0.0

    p_0 = _drawn(s, s.unit[BRIDGE, 0], s.unit[BRIDGE, 1])
    a_0 = a_1 = a_2 = (0.0, 0.0, 0.0)
    if r.filtered:
        a_0 = terminal(s.w[V, 0], s.w[V, 1], s.w[I_O, 0], s.w[I_O, 1])
    g_0 = brought_now(r, s) if r.H_grid > 0.0 else 0.0

    m_r, m_i = drive(r, s, c, part, BRIDGE, E_d, E_q, omega_u)
    p_r, p_i = drive(
        r, s, c, part, GRID, s.V_g * s.sequence[0, 0], s.V_g * s.sequence[0, 1], omega_g
    )
    n_r, n_i = 0.0, 0.0
    if s.unbalance_left > 0.0:
        n_r, n_i = drive(
            r, s, c, part, NEGATIVE, s.V_g * s.sequence[1, 0], s.V_g * s.sequence[1, 1], -omega_g
        )
    half_step(r, s, c, part, 0)
    if r.filtered or r.H_grid > 0.0:
        read_states(r, s, c)
        a_1 = terminal(s.w[V, 0], s.w[V, 1], s.w[I_O, 0], s.w[I_O, 1])
    else:
        s.w[I_F, 0], s.w[I_F, 1] = state(r, s, c, I_F)
    p_1 = _drawn(s, m_r, m_i)
    g_1 = brought(r, s, p_r, p_i, n_r, n_i) if r.H_grid > 0.0 else 0.0

    half_step(r, s, c, part, 2)
    read_states(r, s, c)
    p_2 = _drawn(s, s.unit[BRIDGE, 0], s.unit[BRIDGE, 1])
    if r.H_grid > 0.0:
        s.brought += r.half_h[part] / 3.0 * (g_0 + 4.0 * g_1 + brought_now(r, s))
    v_0 = s.x[V_DC]
    v_1, v_2 = advance_dc_link(r, s, part, p_0, p_1, p_2)
    if r.filtered:
        a_2 = terminal(s.w[V, 0], s.w[V, 1], s.w[I_O, 0], s.w[I_O, 1])
        _sense(r, s, 0, part, v_0, v_1, v_2)
        for j in range(3):
            _sense(r, s, 1 + j, part, a_0[j], a_1[j], a_2[j])
    s.x[DELTA] += 2.0 * r.half_h[part] * r.omega_b * (omega_u - omega_g)


@compiled
def _drawn(s: Any, u_r: float, u_i: float) -> float:
    """Return the power that the bridge draws from the DC link, p.u.; u is its frame's phasor."""
    w_r, w_i = s.w[I_F, 0], s.w[I_F, 1]
    return s.E[0] * (u_r * w_r + u_i * w_i) + s.E[1] * (u_r * w_i - u_i * w_r)


@compiled
def _larger(size: float, other: float) -> float:
    """Return the larger one; infinity if the other is no number."""
    return max(size, other) if other == other else math.inf


@compiled
def _sense(r: Any, s: Any, j: int, part: int, f_0: float, f_1: float, f_2: float) -> None:
    """Pass a quantity through the low-pass of sensor j."""
    s.sensed[j] = (
        r.sensor_weights[part, 0] * s.sensed[j]
        + r.sensor_weights[part, 1] * f_0
        + r.sensor_weights[part, 2] * f_1
        + r.sensor_weights[part, 3] * f_2
    )


@cached
def reconnect(par: PlantRecord, st: PlantRecord) -> None:
    """Go on from the present state in circuits that have changed."""
    r, s = par[0], st[0]
    enter(r, s, circuit(s))
    _write_x(s)


@compiled
def _write_x(s: Any) -> None:
    """Write the currents and voltages of Eq. (1)-(6): w in the converter's own frame."""
    u_r, u_i = s.unit[BRIDGE, 0], s.unit[BRIDGE, 1]
    for i in range(3):
        w_r, w_i = s.w[i, 0], s.w[i, 1]
        s.x[2 * i], s.x[2 * i + 1] = w_r * u_r + w_i * u_i, w_i * u_r - w_r * u_i
