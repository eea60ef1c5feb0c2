"""The plant from tick to tick: take u, advance by one sampling period, give the true values.

The functions are compiled and allocate nothing. `plant` is the `PlantRecords` of a
`gfm_plant.Network`, k the index of one of its converters; quantities are in p.u. of that converter.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.constant_power import draw_power, measure, see_middle
from gfm_plant.dc_link import advance_dc_link
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.names import BAD_COMMAND, DIVERGED, NOT_ASKED
from gfm_plant.protection import follow_voltage, protect, trip
from gfm_plant.quantise import quantise
from gfm_plant.ramps import advance_grid, grid_power, machine_power, settle
from gfm_plant.records import MAX_DELAY, N_COMMANDS, PlantRecords
from gfm_plant.solution import (
    I_F,
    I_O,
    V,
    circuit,
    drive,
    enter,
    grid_source,
    half_step,
    machine_source,
    mirror_sources,
    own,
    read_states,
    state,
)
from gfm_plant.synchro_check import WATCHING, watch
from gfm_runtime.compiled import cached, compiled, inlined

_FAR = 1e6  # a state beyond this many p.u. has diverged


@cached
def plant_start(plant: PlantRecords, x0: NDArray[np.float64], u0: NDArray[np.float64]) -> None:
    """Put a plant fresh from `make_plant`, whose w and unit phasors are set, into the equilibrium
    x0 (N, 8), u0 (N, 4).

    Delay lines, sensor filters and DC sources are filled as if they had been there forever.
    """
    n, now = plant.net[0], plant.now[0]
    enter(n, now, plant.st[0].tick, circuit(n, now))
    for k in range(n.n_converters):
        r, s = plant.par[k], plant.st[k]
        s.x[DELTA], s.x[V_DC] = x0[k, DELTA], x0[k, V_DC]
        _write_x(plant, k)
        for j in range(N_COMMANDS):
            s.u_now[j] = u0[k, j]
            for age in range(MAX_DELAY + 2):
                s.u[age, j] = u0[k, j]
        p, q, v = terminal(x0[k, 2], x0[k, 3], x0[k, 4], x0[k, 5])
        s.sensed[0], s.sensed[1], s.sensed[2], s.sensed[3] = x0[k, V_DC], p, q, v
        if r.i_u_gain == 0.0:
            s.i_reg = u0[k, 0] - r.k_p * (1.0 - x0[k, V_DC])
        s.i_source, s.E[0], s.E[1] = u0[k, 0], s.u_now[2], s.u_now[3]
    settle(n, now)


@compiled
def plant_advance(plant: PlantRecords, u: NDArray[np.float64]) -> None:
    """Take the command u[k] of this tick for a plant of one converter, (3,) or (4,), and go on to
    the next.

    With a delay of n samples and a fraction of one, u[k-n-1] acts for that fraction of the
    period and u[k-n] for the rest; without delay u[k] acts at once. With at least one sample of
    it u[k] need not be known before the plant goes on, see ``plant_is_delayed``.
    """
    if plant_is_delayed(plant):
        plant_step(plant)
        plant_command(plant, 0, u)
    else:
        plant_command(plant, 0, u)
        plant_step(plant)


@compiled
def plant_is_delayed(plant: PlantRecords) -> bool:
    """Whether no u[k] acts in period k, so that the plant advances before it takes u[k].

    The caller can then advance the plant while it waits for u[k].
    """
    delayed = True
    for k in range(plant.net[0].n_converters):
        delayed = delayed and plant.par[k].delay > 0
    return delayed


@compiled
def plant_command(plant: PlantRecords, k: int, u: NDArray[np.float64]) -> None:
    """Put u, (3,) or (4,), through the D/A into the delay line."""
    r, s = plant.par[k], plant.st[k]
    for j in range(len(u)):
        for age in range(r.delay + 1, 0, -1):
            s.u[age, j] = s.u[age - 1, j]
        if math.isfinite(u[j]):
            s.u[0, j] = quantise(u[j], r.dac_lo[j], r.dac_hi[j], r.dac_lsb[j])
        else:
            trip(plant, k, BAD_COMMAND, u[j])


@compiled
def plant_step(plant: PlantRecords) -> None:
    """Go on by one sampling period under the commands in the delay lines."""
    n, now = plant.net[0], plant.now[0]
    for k in range(n.n_converters):
        s = plant.st[k]
        s.before[0], s.before[1], s.before[2], s.before[3] = (
            s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source
        )  # fmt: skip
        for j in range(4):
            s.before[4 + j] = s.sensed[j]
    for k in range(n.n_converters + 2 + n.n_machines):
        now.unit_before[k, 0], now.unit_before[k, 1] = now.unit[k, 0], now.unit[k, 1]
    for i in range(n.n_states):
        now.w_before[i, 0], now.w_before[i, 1] = now.w[i, 0], now.w[i, 1]
    for j in range(n.n_sinks):
        now.v_sink_before[j, 0], now.v_sink_before[j, 1] = now.v_sink[j, 0], now.v_sink[j, 1]
    if n.unbalanced[circuit(n, now)]:
        mirror_sources(n, now, plant.st[0].tick)
    for part in range(n.n_parts):
        if n.stretch[part] > 0.0:
            _stretch(plant, part)

    worst, largest = 0, 0.0
    for k in range(n.n_converters):
        plant.st[k].tick += 1
        size = _size(plant, k)
        if not size < largest:
            worst, largest = k, size
    if largest < _FAR:
        for k in range(n.n_converters):
            _write_x(plant, k)
        for k in range(n.n_converters):
            if plant.st[k].trip != 0:
                follow_voltage(plant, k)
            protect(plant, k)
    else:
        _go_back(plant)
        trip(plant, worst, DIVERGED, largest)
        enter(n, now, plant.st[0].tick, circuit(n, now))
    advance_grid(n, now)
    if now.unbalance_left > 0.0:
        now.unbalance_left -= n.T_s
        if now.unbalance_left < 0.5 * n.T_s:
            now.unbalance_left = now.sequence[0, 1] = 0.0
            now.sequence[1, 0] = now.sequence[1, 1] = 0.0
            now.sequence[0, 0] = 1.0
    if now.check == WATCHING:
        watch(plant)
    if now.faulted:
        now.fault_left -= n.T_s
        if now.fault_left < 0.5 * n.T_s:
            now.faulted = 0
            _reconnect(plant)


@compiled
def _size(plant: PlantRecords, k: int) -> float:
    """Return the largest of the states of converter k, the first of which also has those of the
    network; infinity if one is no number, or the DC link is empty."""
    n, now, s = plant.net[0], plant.now[0], plant.st[k]
    if not s.x[V_DC] > 0.0:
        return math.inf
    size = abs(s.x[DELTA]) / _FAR  # the angle of an island may grow without limit
    first, last = own(k), own(k + 1)
    for i in range(first, last):
        size = _larger(size, abs(now.w[i, 0]) + abs(now.w[i, 1]))
    if k == 0:
        for i in range(own(n.n_converters), n.n_states):
            size = _larger(size, abs(now.w[i, 0]) + abs(now.w[i, 1]))
    for j in range(4):
        size = _larger(size, abs(s.sensed[j]))
    return _larger(_larger(_larger(size, abs(s.x[V_DC])), abs(s.i_reg)), abs(s.i_source))


@compiled
def _go_back(plant: PlantRecords) -> None:
    """Take back the last step, whose result is not good."""
    n, now = plant.net[0], plant.now[0]
    for k in range(n.n_converters):
        s = plant.st[k]
        s.x[DELTA], s.x[V_DC], s.i_reg, s.i_source = (
            s.before[0], s.before[1], s.before[2], s.before[3]
        )  # fmt: skip
        for j in range(4):
            s.sensed[j] = s.before[4 + j]
    for k in range(n.n_converters + 2 + n.n_machines):
        now.unit[k, 0], now.unit[k, 1] = now.unit_before[k, 0], now.unit_before[k, 1]
    for i in range(n.n_states):
        now.w[i, 0], now.w[i, 1] = now.w_before[i, 0], now.w_before[i, 1]
    for j in range(n.n_sinks):
        now.v_sink[j, 0], now.v_sink[j, 1] = now.v_sink_before[j, 0], now.v_sink_before[j, 1]


@compiled
def plant_truth(plant: PlantRecords, k: int, out: NDArray[np.float64]) -> None:
    """Write the true values at this tick to out (15,), in the order of `TRUTH`."""
    r, s, now = plant.par[k], plant.st[k], plant.now[0]
    out[0] = s.x[V_DC]
    out[1], out[3], out[4] = terminal(s.x[2], s.x[3], s.x[4], s.x[5])
    out[2] = s.u_now[1]
    out[5] = math.sqrt(s.x[0] ** 2 + s.x[1] ** 2)
    out[6] = s.x[DELTA]
    out[7] = now.omega_g
    out[8] = now.V_g
    out[9] = s.trip
    if r.tau_dc > 0.0:
        out[10] = s.i_source
    else:
        i_dc = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - s.x[V_DC]) + s.i_reg
        i_max = r.i_max if s.trip == 0 else 0.0
        out[10] = min(max(i_dc, -i_max), i_max)
    v, i = own(k) + V, own(k) + I_F
    out[11], out[12] = now.w[v, 0], now.w[v, 1]
    out[13], out[14] = r.current * now.w[i, 0], r.current * now.w[i, 1]


@compiled
def _stretch(plant: PlantRecords, part: int) -> None:
    """Go on by one stretch of the period, under the commands that act in it."""
    n, now = plant.net[0], plant.now[0]
    for k in range(n.n_converters):
        r, s = plant.par[k], plant.st[k]
        if s.trip == 0:
            for j in range(N_COMMANDS):
                s.u_now[j] = s.u[n.age[part, k], j]
        else:
            s.u_now[1] = now.omega_g + 0.5 * n.T_s * now.omega_g_slope  # see `trip`
        # the modulator divides by the v_dc that it has at the beginning of its period
        most = s.E_most = r.m_max * s.x[V_DC]
        s.E[0], s.E[1] = s.u_now[2], s.u_now[3]
        size = s.E[0] * s.E[0] + s.E[1] * s.E[1]
        if size > most * most:
            scale = most / math.sqrt(size)
            s.E[0] *= scale
            s.E[1] *= scale
        s.E_commanded[0], s.E_commanded[1] = s.E[0], s.E[1]
    c, cut = circuit(n, now), part
    for k in range(n.n_converters):
        if _may_peak(plant, k, part):
            cut = part + n.n_parts
    for _ in range(n.pieces[cut]):
        if cut != part:
            for k in range(n.n_converters):
                if plant.par[k].i_peak < math.inf and plant.st[k].trip == 0:
                    s = plant.st[k]
                    s.E[0], s.E[1] = _within_peak(plant, k, cut)
        _piece(plant, c, cut)


@compiled
def _may_peak(plant: PlantRecords, k: int, part: int) -> bool:
    """Return whether the current of L_f might come near its limit in a stretch of length h.

    With a = omega_b h / L_f and b = omega_b h / C_f it moves by at most a |E - v| +
    a b / 2 |i - i_o|, as without losses i - i_o and v swing against each other; the fifth of the
    limit that is left is for what i_o does meanwhile. A fault at the terminal takes v at once.
    """
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    if not r.i_peak < math.inf or s.trip != 0:
        return False
    if now.faulted:
        return True
    f, c, o = own(k) + I_F, own(k) + V, own(k) + I_O
    u_r, u_i = now.unit[k, 0], now.unit[k, 1]
    E_d, E_q = s.E_commanded[0], s.E_commanded[1]
    E_r, E_i = E_d * u_r - E_q * u_i, E_d * u_i + E_q * u_r
    E_r, E_i = E_r - now.w[c, 0], E_i - now.w[c, 1]
    i_r, i_i = now.w[f, 0], now.w[f, 1]
    d_r, d_i = i_r - now.w[o, 0], i_i - now.w[o, 1]
    h = r.omega_b * n.stretch[part]
    a, b = h / r.L_f, h / r.C_f
    size = r.current * math.sqrt(i_r * i_r + i_i * i_i) + a * math.sqrt(E_r * E_r + E_i * E_i)
    size += 0.5 * a * b * r.current * math.sqrt(d_r * d_r + d_i * d_i)
    return not size < 0.8 * r.i_peak


@compiled
def _within_peak(plant: PlantRecords, k: int, part: int) -> tuple[float, float]:
    """Return the bridge's mean voltage over a piece, in the converter's frame.

    It is the command, unless the current of L_f would leave the limit. The hardware then blocks
    pulses, which on average gives the voltage that keeps the current at the limit, in the direction
    in which the command would have led it.
    """
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    E_d, E_q, most = s.E_commanded[0], s.E_commanded[1], s.E_most
    u_r, u_i = now.unit[k, 0], now.unit[k, 1]
    f, c = own(k) + I_F, own(k) + V
    i_r, i_i = now.w[f, 0] * r.current, now.w[f, 1] * r.current
    i_d, i_q = i_r * u_r + i_i * u_i, i_i * u_r - i_r * u_i
    v_d = now.w[c, 0] * u_r + now.w[c, 1] * u_i
    v_q = now.w[c, 1] * u_r - now.w[c, 0] * u_i
    X = s.u_now[1] * r.L_f
    drop_d, drop_q = v_d + r.R_f * i_d - X * i_q, v_q + r.R_f * i_q + X * i_d
    reach = 2.0 * n.half_h[part] * r.omega_b / r.L_f  # p.u. of current per p.u. of voltage
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


@inlined
def _piece(plant: PlantRecords, c: int, part: int) -> None:
    """Go on by one piece of a stretch under the commands that act."""
    n, now = plant.net[0], plant.now[0]
    omega_g = now.omega_g + 0.5 * n.T_s * now.omega_g_slope  # in the middle of the tick
    for m in range(n.n_modes[c]):
        now.forced[m, 0] = now.forced[m, 1] = now.forced[m, 2] = now.forced[m, 3] = 0.0
    swings = n.H[0] > 0.0 or n.n_machines > 0
    if swings:
        _bring(n, now, now.unit, n.half_h[part] / 3.0)
    for k in range(n.n_converters):
        _look(plant, k, 0, now.unit)
    for k in range(n.n_converters):
        s = plant.st[k]
        drive(n, now, c, part, k, s.E[0], s.E[1], s.u_now[1])
    g = grid_source(n)
    E_r, E_i = now.V_g * now.sequence[0, 0], now.V_g * now.sequence[0, 1]
    drive(n, now, c, part, g, E_r, E_i, omega_g)
    if now.unbalance_left > 0.0:
        E_r, E_i = now.V_g * now.sequence[1, 0], now.V_g * now.sequence[1, 1]
        drive(n, now, c, part, g + 1, E_r, E_i, -omega_g)
    for j in range(1, n.n_machines + 1):
        omega = now.omega[j] + 0.5 * n.T_s * now.slope[j]
        drive(n, now, c, part, machine_source(n, j), n.E[j], 0.0, omega)

    if n.n_sinks > 0:
        draw_power(n, now, c, part)

    half_step(n, now, c, part, 0)
    if n.n_sinks > 0:
        see_middle(n, now, c)
    if swings:
        read_states(n, now, c)
    else:
        for k in range(n.n_converters):
            i = own(k)
            now.w[i, 0], now.w[i, 1] = state(n, now, c, i)
            if plant.par[k].filtered:
                for j in range(i + 1, i + 3):
                    now.w[j, 0], now.w[j, 1] = state(n, now, c, j)
    for k in range(n.n_converters):
        _look(plant, k, 1, now.halfway)
    if swings:
        _bring(n, now, now.halfway, 4.0 * n.half_h[part] / 3.0)

    half_step(n, now, c, part, 2)
    read_states(n, now, c)
    if n.n_sinks > 0:
        measure(n, now, part)
    if swings:
        _bring(n, now, now.unit, n.half_h[part] / 3.0)
    for k in range(n.n_converters):
        _look(plant, k, 2, now.unit)
        r, s = plant.par[k], plant.st[k]
        v_0 = s.x[V_DC]
        v_1, v_2 = advance_dc_link(r, s, n.half_h[part])
        if r.filtered:
            _sense(n, s, k, 0, part, v_0, v_1, v_2)
            for j in range(3):
                _sense(n, s, k, 1 + j, part, s.seen[0, j], s.seen[1, j], s.seen[2, j])
        s.x[DELTA] += 2.0 * n.half_h[part] * n.omega_b * (s.u_now[1] - omega_g)


@compiled
def _bring(n: Any, now: Any, unit: Any, weight: float) -> None:
    """Add to the energy that a finite grid and the machines get in this tick, when the sources'
    phasors are at ``unit``; ``weight`` is that of Simpson's rule, s."""
    if n.H[0] > 0.0:
        now.energy[0] += weight * grid_power(n, now, unit)
    for j in range(1, n.n_machines + 1):
        now.energy[j] -= weight * machine_power(n, now, j, unit)


@inlined
def _look(plant: PlantRecords, k: int, which: int, unit: Any) -> None:
    """Keep the power that bridge k draws, p.u., and what its sensors see at the beginning (0), the
    middle (1) or the end (2) of a piece, when its frame is at ``unit``."""
    r, s, now = plant.par[k], plant.st[k], plant.now[0]
    i = own(k)
    w_r, w_i = now.w[i, 0] * r.current, now.w[i, 1] * r.current
    u_r, u_i = unit[k, 0], unit[k, 1]
    s.drawn[which] = s.E[0] * (u_r * w_r + u_i * w_i) + s.E[1] * (u_r * w_i - u_i * w_r)
    if r.filtered:
        a, b = i + V, i + I_O
        s.seen[which, 0], s.seen[which, 1], s.seen[which, 2] = terminal(
            now.w[a, 0], now.w[a, 1], now.w[b, 0] * r.current, now.w[b, 1] * r.current
        )


@compiled
def _larger(size: float, other: float) -> float:
    """Return the larger one; infinity if the other is no number."""
    return max(size, other) if other == other else math.inf


@inlined
def _sense(n: Any, s: Any, k: int, j: int, part: int, f_0: float, f_1: float, f_2: float) -> None:
    """Pass a quantity through the low-pass of sensor j of converter k."""
    s.sensed[j] = (
        n.sensor_weights[part, k, 0] * s.sensed[j]
        + n.sensor_weights[part, k, 1] * f_0
        + n.sensor_weights[part, k, 2] * f_1
        + n.sensor_weights[part, k, 3] * f_2
    )


@cached
def synchronise(plant: PlantRecords, k: int) -> None:
    """Start the bridge of converter k, whose block is out of the circuits already, on the voltage
    of its capacitor: in phase with it, at its speed and of its size, so that no current flows yet.

    Its DC link has been charged to its reference meanwhile, and its DC source starts from zero.
    """
    s, now, i = plant.st[k], plant.now[0], own(k) + V
    v_r, v_i = now.w[i, 0], now.w[i, 1]
    size = math.sqrt(v_r * v_r + v_i * v_i)
    u_r, u_i = now.unit[k, 0], now.unit[k, 1]
    s.x[DELTA] += math.atan2(v_i * u_r - v_r * u_i, v_r * u_r + v_i * u_i)
    now.unit[k, 0], now.unit[k, 1] = v_r / size, v_i / size
    s.x[V_DC] = s.sensed[0] = 1.0
    s.i_reg = s.i_source = 0.0
    for j in range(N_COMMANDS):
        s.u_now[j] = 0.0
    s.u_now[1], s.u_now[2] = s.omega_seen, size
    for age in range(MAX_DELAY + 2):
        for j in range(N_COMMANDS):
            s.u[age, j] = s.u_now[j]
    s.E[0], s.E[1] = size, 0.0
    s.looked = 0
    s.sums[0] = s.sums[1] = s.i_rms = 0.0
    for j in range(len(s.crossed)):
        s.crossed[j] = 0
    s.trip, s.trip_tick, s.trip_value, s.waits = 0, 0, 0.0, NOT_ASKED
    enter(plant.net[0], now, plant.st[0].tick, circuit(plant.net[0], now))
    _write_x(plant, k)


@cached
def reconnect(plant: PlantRecords) -> None:
    """Go on from the present state in circuits that have changed."""
    _reconnect(plant)


@compiled
def _reconnect(plant: PlantRecords) -> None:
    n, now = plant.net[0], plant.now[0]
    enter(n, now, plant.st[0].tick, circuit(n, now))
    for k in range(n.n_converters):
        _write_x(plant, k)


@compiled
def _write_x(plant: PlantRecords, k: int) -> None:
    """Write the currents and voltages of Eq. (1)-(6): w in the converter's own frame."""
    r, s, now = plant.par[k], plant.st[k], plant.now[0]
    u_r, u_i = now.unit[k, 0], now.unit[k, 1]
    for i in range(3):
        scale = 1.0 if i == V else r.current
        w_r, w_i = now.w[own(k) + i, 0] * scale, now.w[own(k) + i, 1] * scale
        s.x[2 * i], s.x[2 * i + 1] = w_r * u_r + w_i * u_i, w_i * u_r - w_r * u_i
