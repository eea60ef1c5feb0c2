"""The plant from tick to tick: take u, advance by one sampling period, give the true values.

The functions are compiled and allocate nothing. `plant` is the `PlantRecords` of a
`gfm_plant.Network`, k the index of one of its converters; quantities are in p.u. of that converter.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.components import (
    every_at_rest,
    every_begin,
    every_drive,
    every_end,
    every_go_back,
    every_keep,
    every_middle,
    every_tick,
)
from gfm_plant.dc_link import advance_dc_link
from gfm_plant.layout import field
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.names import BAD_COMMAND, DIVERGED, NOT_ASKED
from gfm_plant.protection import follow_voltage, protect, trip
from gfm_plant.quantise import quantise
from gfm_plant.ramps import advance_grid
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
    every_at_rest(plant, circuit(n, now), 0)


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
    unit, unit_before = field(now, "unit"), field(now, "unit_before")
    for k in range(now.n_s):
        unit_before[k] = unit[k]
    w, w_before = field(now, "w"), field(now, "w_before")
    for i in range(n.n_states):
        w_before[i] = w[i]
    every_keep(plant, circuit(n, now), 0)
    if field(n, "unbalanced")[circuit(n, now)]:
        mirror_sources(n, now, plant.st[0].tick)
    for part in range(n.n_parts):
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
    every_tick(plant, circuit(n, now), 0)
    advance_grid(now, n.T_s)
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
    w = field(now, "w")
    for i in range(own(k), own(k + 1)):
        size = _larger(size, abs(w[i].real) + abs(w[i].imag))
    if k == 0:
        for i in range(own(n.n_converters), n.n_states):
            size = _larger(size, abs(w[i].real) + abs(w[i].imag))
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
    unit, unit_before = field(now, "unit"), field(now, "unit_before")
    for k in range(now.n_s):
        unit[k] = unit_before[k]
    w, w_before = field(now, "w"), field(now, "w_before")
    for i in range(n.n_states):
        w[i] = w_before[i]
    every_go_back(plant, circuit(n, now), 0)


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
    v, i = field(now, "w")[own(k) + V], field(now, "w")[own(k) + I_F]
    out[11], out[12] = v.real, v.imag
    out[13], out[14] = r.current * i.real, r.current * i.imag


@compiled
def _stretch(plant: PlantRecords, part: int) -> None:
    """Go on by one stretch of the period, under the commands that act in it."""
    n, now = plant.net[0], plant.now[0]
    age = field(n, "age")
    for k in range(n.n_converters):
        r, s = plant.par[k], plant.st[k]
        if s.trip == 0:
            for j in range(N_COMMANDS):
                s.u_now[j] = s.u[age[part, k], j]
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
    for _ in range(field(n, "pieces")[cut]):
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
    w, at = field(now, "w"), own(k)
    E = complex(s.E_commanded[0], s.E_commanded[1]) * field(now, "unit")[k] - w[at + V]
    h = r.omega_b * field(n, "stretch")[part]
    a, b = h / r.L_f, h / r.C_f
    size = r.current * _length(w[at + I_F]) + a * _length(E)
    size += 0.5 * a * b * r.current * _length(w[at + I_F] - w[at + I_O])
    return not size < 0.8 * r.i_peak


@inlined
def _length(z: complex) -> float:
    """Return |z|; quicker than abs(z), which minds overflow."""
    return math.sqrt(z.real * z.real + z.imag * z.imag)


@compiled
def _within_peak(plant: PlantRecords, k: int, part: int) -> tuple[float, float]:
    """Return the bridge's mean voltage over a piece, in the converter's frame.

    It is the command, unless the current of L_f would leave the limit. The hardware then blocks
    pulses, which on average gives the voltage that keeps the current at the limit, in the direction
    in which the command would have led it.
    """
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    E_d, E_q, most = s.E_commanded[0], s.E_commanded[1], s.E_most
    back = field(now, "unit")[k].conjugate()
    i, v = field(now, "w")[own(k) + I_F], field(now, "w")[own(k) + V] * back
    i = complex(i.real * r.current, i.imag * r.current) * back
    X = s.u_now[1] * r.L_f
    drop_d = v.real + r.R_f * i.real - X * i.imag
    drop_q = v.imag + r.R_f * i.imag + X * i.real
    half_h = field(n, "half_h")[part]
    reach = 2.0 * half_h * r.omega_b / r.L_f  # p.u. of current per p.u. of voltage
    to_d, to_q = i.real + reach * (E_d - drop_d), i.imag + reach * (E_q - drop_q)
    size = math.sqrt(to_d * to_d + to_q * to_q)
    if size <= r.i_peak:
        return E_d, E_q
    scale = r.i_peak / size
    E_d = drop_d + (to_d * scale - i.real) / reach
    E_q = drop_q + (to_q * scale - i.imag) / reach
    size = math.sqrt(E_d * E_d + E_q * E_q)
    if size > most:
        E_d, E_q = E_d * most / size, E_q * most / size
    return E_d, E_q


@inlined
def _piece(plant: PlantRecords, c: int, part: int) -> None:
    """Go on by one piece of a stretch under the commands that act."""
    n, now = plant.net[0], plant.now[0]
    omega_g = now.omega_g + 0.5 * n.T_s * now.omega_g_slope  # in the middle of the tick
    forced, w, half_h = field(now, "forced"), field(now, "w"), field(n, "half_h")[part]
    for m in range(field(n, "n_modes")[c]):
        forced[m, 0] = forced[m, 1] = 0j
    every_begin(plant, c, part)
    for k in range(n.n_converters):
        s = plant.st[k]
        _look(plant, k, 0, field(now, "unit")[k])
        drive(n, now, c, part, k, complex(s.E[0], s.E[1]), s.u_now[1])
    for sequence in range(2 if now.unbalance_left > 0.0 else 1):
        E = now.sequence[sequence]
        E = complex(now.V_g * E.real, now.V_g * E.imag)
        drive(n, now, c, part, grid_source(n) + sequence, E, omega_g if sequence == 0 else -omega_g)
    every_drive(plant, c, part)

    half_step(n, now, c, part, 0)
    every_middle(plant, c, part)
    for k in range(n.n_converters):
        for i in range(own(k), own(k) + (3 if plant.par[k].filtered else 1)):
            w[i] = state(n, now, c, i)
        _look(plant, k, 1, field(now, "halfway")[k])

    half_step(n, now, c, part, 1)
    read_states(n, now, c)
    every_end(plant, c, part)
    for k in range(n.n_converters):
        _look(plant, k, 2, field(now, "unit")[k])
        r, s = plant.par[k], plant.st[k]
        v_0 = s.x[V_DC]
        v_1, v_2 = advance_dc_link(r, s, half_h)
        if r.filtered:
            _sense(n, s, k, 0, part, v_0, v_1, v_2)
            for j in range(3):
                _sense(n, s, k, 1 + j, part, s.seen[0, j], s.seen[1, j], s.seen[2, j])
        s.x[DELTA] += 2.0 * half_h * n.omega_b * (s.u_now[1] - omega_g)


@inlined
def _look(plant: PlantRecords, k: int, which: int, unit: complex) -> None:
    """Keep the power that bridge k draws, p.u., and what its sensors see at the beginning (0), the
    middle (1) or the end (2) of a piece, when its frame is at ``unit``."""
    r, s, w, at = plant.par[k], plant.st[k], field(plant.now[0], "w"), own(k)
    i, v, i_o = w[at + I_F], w[at + V], w[at + I_O]
    turned = unit.conjugate() * complex(i.real * r.current, i.imag * r.current)
    s.drawn[which] = s.E[0] * turned.real + s.E[1] * turned.imag
    if r.filtered:
        s.seen[which, 0], s.seen[which, 1], s.seen[which, 2] = terminal(
            v.real, v.imag, i_o.real * r.current, i_o.imag * r.current
        )


@compiled
def _larger(size: float, other: float) -> float:
    """Return the larger one; infinity if the other is no number."""
    return max(size, other) if other == other else math.inf


@inlined
def _sense(n: Any, s: Any, k: int, j: int, part: int, f_0: float, f_1: float, f_2: float) -> None:
    """Pass a quantity through the low-pass of sensor j of converter k."""
    weights = field(n, "lag_weights")
    s.sensed[j] = (
        weights[part, k, 0] * s.sensed[j]
        + weights[part, k, 1] * f_0
        + weights[part, k, 2] * f_1
        + weights[part, k, 3] * f_2
    )


@cached
def synchronise(plant: PlantRecords, k: int) -> None:
    """Start the bridge of converter k, whose block is out of the circuits already, on the voltage
    of its capacitor: in phase with it, at its speed and of its size, so that no current flows yet.

    Its DC link has been charged to its reference meanwhile, and its DC source starts from zero.
    """
    s, now = plant.st[k], plant.now[0]
    v, unit = field(now, "w")[own(k) + V], field(now, "unit")
    size, ahead = _length(v), v * unit[k].conjugate()
    s.x[DELTA] += math.atan2(ahead.imag, ahead.real)
    unit[k] = complex(v.real / size, v.imag / size)
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
    back = field(now, "unit")[k].conjugate()
    for i in range(3):
        scale, w = 1.0 if i == V else r.current, field(now, "w")[own(k) + i]
        turned = complex(w.real * scale, w.imag * scale) * back
        s.x[2 * i], s.x[2 * i + 1] = turned.real, turned.imag
