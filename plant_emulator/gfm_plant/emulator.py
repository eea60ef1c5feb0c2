"""The plant from tick to tick: take u, advance by one sampling period, give the true values.

The functions are compiled and allocate nothing. `plant` is the `PlantRecords` of a
`gfm_plant.Network`, k the index of one of its converters; quantities are in p.u. of that converter.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gfm_plant.clearing import begin_clearing
from gfm_plant.components import TICK, call_components, every_at_rest
from gfm_plant.dc_link import limit_dc_source
from gfm_plant.layout import CHECK_SIDES, field
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.names import BAD_COMMAND, DIVERGED, NOT_ASKED
from gfm_plant.period import advance, go_back, keep, length
from gfm_plant.phases import convert
from gfm_plant.protection import follow_voltage, protect, trip
from gfm_plant.pv_array import array_current, most_power
from gfm_plant.quantise import quantise
from gfm_plant.ramps import advance_grid
from gfm_plant.records import ACROSS, COMPARE, I_F, MAX_DELAY, N_COMMANDS, PlantRecords, V
from gfm_plant.solution import circuit, enter, mirror_sources, node_voltage, own
from gfm_plant.synchro_check import WATCHING
from gfm_runtime.by_address import call_at
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
        if r.i_u_gain == 0.0 and r.array != ACROSS:
            s.i_reg = u0[k, 0] - r.k_p * (1.0 - x0[k, V_DC])
        s.i_source, s.E[0], s.E[1] = u0[k, 0], s.u_now[2], s.u_now[3]
        s.ahead = complex(1.0, 0.0)
        for x in range(3):  # a period of the carrier begins at its lower end, all legs above it
            s.level[x], s.gate[x], s.on_at[x] = r.levels - 1, 2 * (r.levels - 1), math.inf
        if r.array != 0:
            s.irradiance = s.irradiance_to = r.irradiance
            s.P_array = most_power(r, r.irradiance)[0]
        s.soc, s.i_most[0], s.i_most[1] = r.soc[0], r.i_max, -r.i_max
        limit_dc_source(r, s)
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


@inlined
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


@inlined
def plant_step(plant: PlantRecords) -> None:
    """Go on by one sampling period under the commands in the delay lines.

    The loops reach it by an address in the plant's records, see `ways`."""
    call_at(plant.net[0].step, plant.net[0].records, 0.0, 0.0)


@inlined
def whole_period(plant: PlantRecords) -> None:
    """``plant_step`` itself."""
    n, now = plant.net[0], plant.now[0]
    keep(plant)
    if field(n, "unbalanced")[circuit(n, now)]:
        mirror_sources(n, now, plant.st[0].tick)
    for k in range(n.n_converters):
        plant.st[k].phase_sums[0] = math.nan
    if now.clearing:
        call_at(n.clear, n.records, 0.0, 0.0)
    elif n.conversions > 1:
        _advance_converting(plant)
    else:
        advance(plant, 0.0, math.inf)

    worst, largest = 0, 0.0
    for k in range(n.n_converters):
        plant.st[k].tick += 1
        limit_dc_source(plant.par[k], plant.st[k])
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
        go_back(plant)
        trip(plant, worst, DIVERGED, largest)
        enter(n, now, plant.st[0].tick, circuit(n, now))
    call_components(plant, TICK, circuit(n, now))
    advance_grid(now, n.T_s)
    if now.check == WATCHING:
        call_at(n.watch, n.records, 0.0, 0.0)
    if now.contact:
        now.fault_left -= n.T_s
        if now.fault_left < 0.5 * n.T_s and begin_clearing(n, now):
            _reconnect(plant)


@compiled
def _advance_converting(plant: PlantRecords) -> None:
    """Go on by one period, with all conversions of the A/D at the phases."""
    n = plant.net[0]
    for m in range(n.conversions):
        end = n.T_s * (m + 1) / n.conversions
        advance(plant, n.T_s * m / n.conversions, end if m + 1 < n.conversions else math.inf)
        for k in range(n.n_converters):
            convert(plant, k, m, end)


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
    elif r.array == ACROSS:
        out[10] = array_current(r, s.irradiance, s.x[V_DC]) if s.trip == 0 else 0.0
    else:
        i_dc = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - s.x[V_DC]) + s.i_reg
        out[10] = min(max(i_dc, s.i_most[1]), s.i_most[0]) if s.trip == 0 else 0.0
    v, i = field(now, "w")[own(k) + V], field(now, "w")[own(k) + I_F]
    out[11], out[12] = v.real, v.imag
    out[13], out[14] = r.current * i.real, r.current * i.imag


@inlined
def plant_options(plant: PlantRecords, k: int, out: NDArray[np.float64]) -> None:
    """Write what a plant with options has besides `TRUTH` at this tick to out: with ``connections``
    p, q and V at the connection point, in the order of `CONNECTION`, which is behind the second
    inductor or the transformer of a converter that has one, else at the filter capacitor; with
    ``batteries`` the state of charge."""
    n, now = plant.net[0], plant.now[0]
    if n.connections != 0:
        call_at(n.connection, n.records, k, 0.0)
        out[0], out[1], out[2] = now.connection[0], now.connection[1], now.connection[2]
    if n.batteries != 0:
        out[len(out) - 1] = plant.st[k].soc


@compiled
def look_at_connection(plant: PlantRecords, k: int) -> None:
    """Write p, q and V at the connection point of converter k to ``connection``."""
    n, now, place = plant.net[0], plant.now[0], CHECK_SIDES + k
    v, scale = node_voltage(n, now, place, plant.st[k].tick), plant.par[k].current
    i = field(now, "w")[field(n, "node_i")[place]]
    p, q, V = terminal(v.real, v.imag, scale * i.real, scale * i.imag)
    now.connection[0], now.connection[1], now.connection[2] = p, q, V


@compiled
def _larger(size: float, other: float) -> float:
    """Return the larger one; infinity if the other is no number."""
    return max(size, other) if other == other else math.inf


@cached
def synchronise(plant: PlantRecords, k: int) -> None:
    """Start the bridge of converter k, whose block is out of the circuits already, on the voltage
    of its capacitor: in phase with it, at its speed and of its size, so that no current flows yet.

    Its DC link has been charged to its reference meanwhile, and its DC source starts from zero.
    """
    s, now = plant.st[k], plant.now[0]
    v, unit = field(now, "w")[own(k) + V], field(now, "unit")
    size, ahead = length(v), v * unit[k].conjugate()
    s.x[DELTA] += math.atan2(ahead.imag, ahead.real)
    unit[k] = complex(v.real / size, v.imag / size)
    s.x[V_DC] = s.sensed[0] = 1.0
    s.i_reg = s.i_source = 0.0
    for j in range(N_COMMANDS):
        s.u_now[j] = -1.0 if j >= COMPARE else 0.0
    s.u_now[1], s.u_now[2] = s.omega_seen, size
    for age in range(MAX_DELAY + 2):
        for j in range(N_COMMANDS):
            s.u[age, j] = s.u_now[j]
    s.E[0], s.E[1], s.mid = size, 0.0, 0.0
    s.looked = 0
    s.sums[0] = s.sums[1] = s.i_rms = 0.0
    for j in range(len(s.crossed)):
        s.crossed[j] = 0
    s.trip, s.trip_tick, s.trip_value, s.waits = 0, 0, 0.0, NOT_ASKED
    enter(plant.net[0], now, plant.st[0].tick, circuit(plant.net[0], now))
    _write_x(plant, k)


@cached
def clear(plant: PlantRecords) -> None:
    """Clear the fault, if there is one, or begin to."""
    if plant.now[0].contact and begin_clearing(plant.net[0], plant.now[0]):
        _reconnect(plant)


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
