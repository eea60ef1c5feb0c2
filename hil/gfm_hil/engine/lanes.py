"""Several runs of one converter each, tick by tick in one compiled loop: run j is lane j of every
number in two records, so that the processor computes the same of all runs at a time.

A lane has the bits of a run alone: each operation is that of the plant's and the controller's own
functions, in their order. It knows the calm ticks of the plainest plant, and looks in each tick
whether it was one. In any other, as one in which a limit acts, a protection picks up or a number is
not finite, the run goes on by itself from before it.
"""

import math
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gfm_hil.engine.inproc import Steps, Stretch
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.vectors import WIDTH as LANES
from gfm_hil.engine.vectors import bits, everywhere, plus, put, times, vector, where
from gfm_hil.realtime.atomics import row_at
from gfm_hil.recording.parts import MemoryPart
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.noise import normal_pair, random_bits
from gfm_plant.records import MAX_DELAY, N_TRIPS
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.error_maps import LINEAR
from gfm_runtime.inner.stage import NEGLIGIBLE, limited
from gfm_runtime.signals import NU, NY
from gfm_runtime.states import RUNNING

T = TypeVar("T")
_Places = tuple[NDArray[np.int64], NDArray[np.int64], int]

BLOCK = 50  # ticks after which one that was not calm is noticed
_MODES = 3  # of the filter and the line, whose states are as many
_PARTS = 2  # of a period, at most: one before and one behind a fraction of a sample of delay
_ORDER = 5  # of a law, at most
_AGES = MAX_DELAY + 2
_FAR = 1e6  # p.u.; a state beyond that has diverged
_ROUGH = 1e-6  # p.u.; a larger last term of v_dc asks for finer steps
_SERIES = 0.03  # rad; up to which an angle's sine and cosine are series
_NEAR = 1e-8  # of a mode, to the speed of a source
_1_2, _1_3, _1_4, _1_5 = 1 / 2, 1 / 3, 1 / 4, 1 / 5
#: what a lane records of the plant in each tick; a number that stays in calm ticks is none of them
MOVING = ("true_p", "true_omega_u", "true_V", "true_i", "true_delta")
_RECORDED = {*MOVING, "true_omega_g", "true_V_g", "law"}


def _record(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    return np.dtype([(name, kind, (*shape, LANES)) for name, kind, *shape in fields], align=True)


_PLANT = ("m_max", "omega_b", "current", "i_u_gain", "k_p", "k_i", "C_dc", "seed")
_SENSORS = ("gain", "offset", "noise_std", "adc_lo", "adc_hi", "adc_lsb")
_DAC = ("dac_lo", "dac_hi", "dac_lsb")
_LAW = ("A", "B_y", "C", "D_y", "u_0", "W", "loop", "low", "high", "decay", "follow")

#: what stays; the names are those of the plant's, the circuits' and the law's records
fixed_dtype = _record(
    *((name, "f8") for name in _PLANT[:-1]), ("seed", "u8"), ("i_most", "f8", 2),
    ("half_h", "f8", _PARTS), ("age", "i8", _PARTS), ("lag_weights", "f8", _PARTS, 4),
    *((name, "f8", 4) for name in _SENSORS), *((name, "f8", NU) for name in _DAC),
    ("rate", "f8", 2, _MODES), ("decay_z", "f8", _PARTS, 2, _MODES), ("drive", "f8", 2, _MODES),
    ("states", "f8", _MODES, 2, _MODES), ("grid_gain", "f8", _PARTS, 2, _MODES),
    ("grid_turn", "f8", 2, _PARTS), ("E_grid", "f8", 2, 1), ("omega_grid", "f8"),
    ("trips", "i8", N_TRIPS), ("trip_limit", "f8", N_TRIPS),
    ("y_low", "f8", NY), ("y_high", "f8", NY),
    ("A", "f8", _ORDER, _ORDER), ("B_y", "f8", _ORDER, NY), ("x_ref", "f8", _ORDER),
    ("C", "f8", NU, _ORDER), ("D_y", "f8", NU, NY), ("from_ref", "f8", NU, NY),
    ("u_0", "f8", NU), ("W", "f8", _ORDER, NU), ("loop", "f8"), ("low", "f8", NU),
    ("high", "f8", NU), ("decay", "f8"), ("follow", "f8"),
)  # fmt: skip
#: what changes from tick to tick
moving_dtype = _record(
    ("tick", "i8"), ("x", "f8", 8), ("i_reg", "f8"), ("sensed", "f8", 4),
    ("u", "f8", _AGES, NU), ("E_q", "f8"), ("u_now", "f8", NU), ("E", "f8", 2), ("E_most", "f8"),
    ("noise", "f8", 4), ("z", "f8", 2, _MODES), ("forced", "f8", 2, 2, _MODES),
    ("w", "f8", 2, _MODES), ("unit", "f8", 2, 2),
    ("y", "f8", NY), ("seen_y", "f8", NY), ("x_law", "f8", _ORDER), ("x_next", "f8", _ORDER),
    ("raw", "f8", NU), ("now", "f8", NU), ("off", "f8", NU), ("u_law", "f8", NU),
    ("trend", "f8", NU), ("kept", "f8", len(MOVING)),
)  # fmt: skip


@inlined
def _z(numbers, k):
    """Return complex number k of all lanes."""
    return vector(numbers[0, k]), vector(numbers[1, k])


@inlined
def _put_z(numbers, k, z):
    put(numbers[0, k], z[0])
    put(numbers[1, k], z[1])


@inlined
def _quantised(x, low, high, lsb):
    """As `gfm_plant.quantise.quantise`."""
    x = limited(x, low, high)
    return where(lsb > 0.0, low + lsb * np.floor((x - low) / lsb + 0.5), x)


@inlined
def _faded(x):
    """As `gfm_runtime.inner.faded`."""
    return where(abs(x) < NEGLIGIBLE, 0.0, x)


@inlined
def _sample(n, c, s):
    """As `gfm_plant.sensors.read_sensors`; returns which lanes are calm."""
    for pair in range(2):
        for j in range(n):
            random = random_bits(c.seed[j], s.tick[j], pair)
            s.noise[2 * pair, j], s.noise[2 * pair + 1, j] = normal_pair(random)
    for k in range(4):
        value = vector(c.gain[k]) * vector(s.sensed[k]) + vector(c.offset[k])
        value = value + vector(c.noise_std[k]) * vector(s.noise[k])
        low, high, lsb = vector(c.adc_lo[k]), vector(c.adc_hi[k]), vector(c.adc_lsb[k])
        put(s.y[k if k < 2 else k + 1], _quantised(value, low, high, lsb))
    put(s.y[2], vector(s.u_now[1]))
    calm = everywhere(True)
    for k in range(NY):
        y = vector(s.y[k])
        calm = calm & (vector(c.y_low[k]) <= y) & (y <= vector(c.y_high[k]))
        put(s.seen_y[k], y)
    return calm


@inlined
def _row(c, s, i, order):
    """As of `gfm_runtime.kernel`."""
    raw = vector(c.u_0[i]) + vector(s.off[i])
    for k in range(order):
        raw = raw + vector(c.C[i, k]) * vector(s.x_law[k])
    for k in range(NY):
        raw = raw + vector(c.from_ref[i, k])
    for k in range(NY):
        if k != 2:
            raw = raw + vector(c.D_y[i, k]) * vector(s.seen_y[k])
    return raw


@inlined
def _control(c, s, order):
    """As `look` and `advance` of `gfm_runtime.kernel`; returns which lanes are calm."""
    omega_u = _row(c, s, 1, order) * vector(c.loop)
    put(s.raw[1], omega_u)
    omega_u = limited(omega_u, vector(c.low[1]), vector(c.high[1]))
    put(s.now[1], omega_u)
    put(s.seen_y[2], omega_u)
    for i in (0, 2):
        raw = _row(c, s, i, order) + vector(c.D_y[i, 2]) * omega_u
        put(s.raw[i], raw)
        put(s.now[i], limited(raw, vector(c.low[i]), vector(c.high[i])))
    for k in range(order):
        x = vector(s.x_law[k])
        for i in range(NU):
            excess = vector(s.now[i]) - vector(s.raw[i])
            x = where(excess != 0.0, x + vector(c.W[k, i]) * excess, x)
        put(s.x_law[k], x)
    calm, decay, follow = everywhere(True), vector(c.decay), vector(c.follow)
    for i in range(NU):
        now, trend = vector(s.now[i]), vector(s.trend[i])
        calm = calm & (abs(now) < math.inf)
        put(s.off[i], _faded(vector(s.off[i]) * decay))
        change = now - vector(s.u_law[i]) - trend
        put(s.trend[i], _faded(trend + follow * change))
        put(s.u_law[i], now)
    for i in range(order):
        x = vector(c.x_ref[i])
        for k in range(NY):
            x = x + vector(c.B_y[i, k]) * vector(s.seen_y[k])
        for k in range(order):
            x = x + vector(c.A[i, k]) * vector(s.x_law[k])
        put(s.x_next[i], x)
    for i in range(order):
        put(s.x_law[i], _faded(vector(s.x_next[i])))
    return calm


@inlined
def _command(c, s):
    """As `gfm_plant.emulator.plant_command`."""
    for i in range(NU):
        for age in range(_AGES - 1, 0, -1):
            put(s.u[age, i], vector(s.u[age - 1, i]))
        low, high, lsb = vector(c.dac_lo[i]), vector(c.dac_hi[i]), vector(c.dac_lsb[i])
        put(s.u[0, i], _quantised(vector(s.now[i]), low, high, lsb))


@inlined
def _look(c, s, E, unit):
    """As of `gfm_plant.period`: what the bridge draws; p, q and V."""
    i, v, i_o, scale = _z(s.w, 0), _z(s.w, 1), _z(s.w, 2), vector(c.current)
    turned = times((unit[0], -unit[1]), (i[0] * scale, i[1] * scale))
    return E[0] * turned[0] + E[1] * turned[1], terminal(v[0], v[1], i_o[0] * scale, i_o[1] * scale)


@inlined
def _turn_on(s, k, turn):
    """As of `gfm_plant.solution`; returns the phasor in the middle of a piece, and at its end."""
    middle = times(_z(s.unit, k), turn)
    u = times(middle, turn)
    length = 1.5 - 0.5 * (u[0] * u[0] + u[1] * u[1])
    end = u[0] * length, u[1] * length
    _put_z(s.unit, k, end)
    return middle, end


@inlined
def _drive(c, s, part, E, h):
    """As of `gfm_plant.solution`, of the bridge and the grid; returns the bridge's phasors as
    ``_turn_on``, and which lanes are calm."""
    away, turns = vector(c.omega_b) * (vector(s.u_now[1]) - 1.0), _z(c.grid_turn, part)
    x = away * h
    x2 = x * x
    turn = (
        1.0 - x2 * (1 / 2 - x2 * (1 / 24 - x2 * (1 / 720 - x2 * (1 / 40320)))),
        x * (1.0 - x2 * (1 / 6 - x2 * (1 / 120 - x2 * (1 / 5040 - x2 * (1 / 362880))))),
    )
    calm = abs(x) < _SERIES
    driven, held = times(E, _z(s.unit, 0)), times(_z(c.E_grid, 0), _z(s.unit, 1))
    for m in range(_MODES):
        rate, decay = _z(c.rate, m), _z(c.decay_z[part], m)
        d = -rate[0], away - rate[1]
        size = d[0] * d[0] + d[1] * d[1]
        calm = calm & (size * h * h > _NEAR)
        per_size = 1.0 / size
        g = times((turn[0] - decay[0], turn[1] - decay[1]), (d[0], -d[1]))
        gain = times((g[0] * per_size, g[1] * per_size), _z(c.drive, m))
        f, f_grid = times(gain, driven), times(_z(c.grid_gain[part], m), held)
        _put_z(s.forced[0], m, plus(plus((0.0, 0.0), f), f_grid))
        later = plus(plus((0.0, 0.0), times(f, turn)), times(f_grid, turns))
        _put_z(s.forced[1], m, later)
    _turn_on(s, 1, turns)
    return _turn_on(s, 0, turn), calm


@inlined
def _half_step(c, s, part, which):
    for m in range(_MODES):
        z = times(_z(c.decay_z[part], m), _z(s.z, m))
        _put_z(s.z, m, plus(z, _z(s.forced[which], m)))
    for i in range(_MODES):
        w = plus((0.0, 0.0), times(_z(c.states[i], 0), _z(s.z, 0)))
        w = plus(w, times(_z(c.states[i], 1), _z(s.z, 1)))
        _put_z(s.w, i, plus(w, times(_z(c.states[i], 2), _z(s.z, 2))))


@inlined
def _asks(c, v, i, i_u):
    """Whether the DC source's control asks for what is between its limits."""
    asked = i_u + vector(c.k_p) * (1.0 - v) + i
    return ~((asked > vector(c.i_most[0])) | (asked < vector(c.i_most[1])))


@inlined
def _low_pass(c, s, part, k, f_0, f_1, f_2):
    weights = c.lag_weights[part]
    sensed = vector(weights[0]) * vector(s.sensed[k]) + vector(weights[1]) * f_0
    put(s.sensed[k], sensed + vector(weights[2]) * f_1 + vector(weights[3]) * f_2)


@inlined
def _dc_link(c, s, part, half, drawn):
    """As `gfm_plant.dc_link.advance_dc_link` in one step, and the sensor of v_dc; returns which
    lanes are calm."""
    h, v, i, k_p = 2.0 * half, vector(s.x[V_DC]), vector(s.i_reg), vector(c.k_p)
    i_u = vector(c.i_u_gain) * vector(s.u_now[0])
    H, K = h * vector(c.omega_b) / vector(c.C_dc), h * vector(c.k_i)
    d_0, d_1, d_2 = drawn
    v_0 = v
    b, a = 4.0 * d_1 - 3.0 * d_0 - d_2, 2.0 * (d_0 + d_2) - 4.0 * d_1
    calm, t_0, per_v = _asks(c, v, i, i_u), i_u + k_p * (1.0 - v) + i, 1.0 / v
    c_0 = d_0 * per_v
    v_1, i_1 = H * (t_0 - c_0), K * (1.0 - v)
    t_1 = i_1 - k_p * v_1
    c_1 = (b - v_1 * c_0) * per_v
    v_2, i_2 = _1_2 * H * (t_1 - c_1), -_1_2 * K * v_1
    t_2 = i_2 - k_p * v_2
    c_2 = (a - v_1 * c_1 - v_2 * c_0) * per_v
    v_3, i_3 = _1_3 * H * (t_2 - c_2), -_1_3 * K * v_2
    t_3 = i_3 - k_p * v_3
    c_3 = -(v_1 * c_2 + v_2 * c_1 + v_3 * c_0) * per_v
    v_4, i_4 = _1_4 * H * (t_3 - c_3), -_1_4 * K * v_3
    t_4 = i_4 - k_p * v_4
    c_4 = -(v_1 * c_3 + v_2 * c_2 + v_3 * c_1 + v_4 * c_0) * per_v
    v_5, i_5 = _1_5 * H * (t_4 - c_4), -_1_5 * K * v_4
    v_middle = v + (v_1 + (v_2 + (v_3 + (v_4 + v_5 / 2.0) / 2.0) / 2.0) / 2.0) / 2.0
    v = v + (v_1 + (v_2 + (v_3 + (v_4 + v_5))))
    i = i + (i_1 + (i_2 + (i_3 + (i_4 + i_5))))
    put(s.x[V_DC], v)
    put(s.i_reg, i)
    _low_pass(c, s, part, 0, v_0, v_middle, v)
    return calm & (abs(v_5) <= _ROUGH) & _asks(c, v, i, i_u)


@inlined
def _advance(c, s, parts, ages):
    """As `gfm_plant.emulator.plant_step`; returns which lanes are calm."""
    calm = everywhere(True)
    for part in range(parts):
        age, h = vector(c.age[part]), vector(c.half_h[part])
        for i in range(NU):
            u = vector(s.u[0, i])
            for k in range(1, ages):
                u = where(age == k, vector(s.u[k, i]), u)
            put(s.u_now[i], u)
        E, most = (vector(s.u_now[2]), vector(s.E_q)), vector(c.m_max) * vector(s.x[V_DC])
        put(s.E[0], E[0])
        put(s.E[1], E[1])
        put(s.E_most, most)
        calm = calm & ~(E[0] * E[0] + E[1] * E[1] > most * most)
        drawn_0, seen_0 = _look(c, s, E, _z(s.unit, 0))
        (middle, end), near = _drive(c, s, part, E, h)
        _half_step(c, s, part, 0)
        drawn_1, seen_1 = _look(c, s, E, middle)
        _half_step(c, s, part, 1)
        drawn_2, seen_2 = _look(c, s, E, end)
        calm = calm & near & _dc_link(c, s, part, h, (drawn_0, drawn_1, drawn_2))
        for k in range(3):
            _low_pass(c, s, part, 1 + k, seen_0[k], seen_1[k], seen_2[k])
        away = vector(s.u_now[1]) - vector(c.omega_grid)
        put(s.x[DELTA], vector(s.x[DELTA]) + 2.0 * h * vector(c.omega_b) * away)
    unit = _z(s.unit, 0)
    for i in range(_MODES):
        w = _z(s.w, i)
        scaled = w
        if i != 1:
            scaled = w[0] * vector(c.current), w[1] * vector(c.current)
        turned = times(scaled, (unit[0], -unit[1]))
        put(s.x[2 * i], turned[0])
        put(s.x[2 * i + 1], turned[1])
        calm = calm & (abs(w[0]) + abs(w[1]) < _FAR)
    v_dc, delta, i_reg = vector(s.x[V_DC]), vector(s.x[DELTA]), vector(s.i_reg)
    calm = calm & (v_dc > 0.0) & (v_dc < _FAR) & (abs(delta) < _FAR * _FAR)
    return calm & (abs(i_reg) < _FAR)


@inlined
def _is_within(c, trip, quantity, sign):
    """Whether a quantity does not pass a threshold upwards, or with -1 downwards, or may."""
    beyond = sign * (quantity - vector(c.trip_limit[trip]))
    return ~(beyond > 0.0) | (vector(c.trips[trip]) == 0)


@inlined
def _protect(c, s):
    """As of `gfm_plant.protection`: which lanes have no quantity beyond its threshold."""
    i_d, i_q, v_d, v_q = vector(s.x[0]), vector(s.x[1]), vector(s.x[2]), vector(s.x[3])
    i, v = np.sqrt(i_d * i_d + i_q * i_q), np.sqrt(v_d * v_d + v_q * v_q)
    v_dc, omega = vector(s.x[V_DC]), vector(s.u_now[1])
    return (
        _is_within(c, 0, i, 1.0) & _is_within(c, 1, v, 1.0) & _is_within(c, 2, v, -1.0)
        & _is_within(c, 3, v_dc, 1.0) & _is_within(c, 4, v_dc, -1.0)
        & _is_within(c, 5, omega, 1.0) & _is_within(c, 6, omega, -1.0)
    )  # fmt: skip


@inlined
def _keep(n, s, used, columns, k):
    """Record what moves of the used lanes, as `gfm_plant.emulator.plant_truth`."""
    i_d, i_q, v_d, v_q = vector(s.x[0]), vector(s.x[1]), vector(s.x[2]), vector(s.x[3])
    p, _, V = terminal(v_d, v_q, vector(s.x[4]), vector(s.x[5]))
    put(s.kept[0], p)
    put(s.kept[1], vector(s.u_now[1]))
    put(s.kept[2], V)
    put(s.kept[3], np.sqrt(i_d * i_d + i_q * i_q))
    put(s.kept[4], vector(s.x[DELTA]))
    for j in range(n):
        for i in range(len(columns) if used[j] else 0):
            row_at(columns[i, j], 1, k)[0] = s.kept[i, j]


@compiled
def _run_lanes(n, fixed, moving, before, used, columns, order, parts, ticks):
    """Run ticks, of all lanes, in whole blocks; returns after how many some ``used`` lane is upset,
    which then is in the next block, at whose beginning all are, and which lanes are, as bits."""
    c, s, mine, ages = fixed[0], moving[0], 0, 1
    for j in range(n):
        mine |= used[j] << j
        for part in range(parts):
            ages = max(ages, 1 + c.age[part, j])
    for first in range(0, ticks, BLOCK):
        before[0] = moving[0]
        calm = everywhere(True)
        for k in range(first, min(first + BLOCK, ticks)):
            _keep(n, s, used, columns, k)
            calm = calm & _sample(n, c, s)
            calm = calm & _control(c, s, order)
            calm = calm & _advance(c, s, parts, ages)
            for j in range(n):
                s.tick[j] += 1
            calm = calm & _protect(c, s)
            _command(c, s)
        upset = mine & bits(~calm)
        if upset:
            moving[0] = before[0]
            return first, upset
    return ticks, 0


class Lanes:
    """Runs side by side, each in a lane; a lane may be empty."""

    def __init__(self) -> None:
        stays, size = fixed_dtype.itemsize // 8, (fixed_dtype.itemsize + moving_dtype.itemsize) // 8
        room = np.zeros(size + LANES, np.int64)
        # where a line of the processor's cache begins: else the loop takes a fifth longer
        words = room[-room.ctypes.data % (8 * LANES) // 8 :][:size]
        self._fixed = words[:stays].view(fixed_dtype)
        self._moving = words[stays:].view(moving_dtype)
        self._words = words.reshape(-1, LANES)  # of all lanes
        self._before, self._used = self._moving.copy(), np.zeros(LANES, np.int64)
        self._kind: tuple[int, int] = 0, 0  # what all lanes have in common: order and parts
        # where the next tick of each lane is recorded, by columns; an empty one's nowhere
        self._columns = np.empty((len(MOVING), LANES), np.int64)

    def enter(self, j: int, stretch: Stretch) -> bool:
        """Put a run into the empty lane j, if its ticks may be calm and like those of the others;
        returns whether."""
        bench, columns = stretch.those.benches[0], _columns(stretch)
        kind = _kind_of(bench) if {*MOVING} <= {*columns} <= _RECORDED else None
        if kind is None or (self._used.any() and kind != self._kind):
            return False
        self._kind, self._used[j] = kind, 1
        self._columns[:, j] = [columns[name][stretch.start :].ctypes.data for name in MOVING]
        for words, rows, places, _ in _copied(bench):
            self._words[rows, j] = words[places]
        plant, c, fixed = bench.plant, bench.controller, self._fixed[0]
        r, now, ctl = plant.par[0], plant.now[0], c.ctl[0]
        law = c.laws[int(ctl["active"])]
        E = now["sequence"][0]
        fixed["E_grid"][:, 0, j] = now["V_g"] * E.real, now["V_g"] * E.imag
        fixed["trips"][:, j] = r["trip_ticks"][:N_TRIPS] >= 0
        ref, x_ref = ctl["ref"], fixed["x_ref"][:, j]  # what the references bring to a law
        fixed["from_ref"][..., j] = law["D_u0"] * ref + law["D_r"] * ref
        by_ref = law["B_r"][: len(x_ref)] * ref
        x_ref[:] = by_ref[:, 0]
        for column in by_ref.T[1:]:
            x_ref += column
        return True

    def leave(self, j: int, stretch: Stretch, k: int) -> None:
        """Give the run in lane j back its records, as they are now at tick k, with what stayed in
        its columns, and empty the lane."""
        bench = stretch.those.benches[0]
        self._used[j] = 0
        for words, rows, places, stay in _copied(bench):
            words[places[stay:]] = self._words[rows[stay:], j]
        s, now, ctl = bench.plant.st[0], bench.plant.now[0], bench.controller.ctl[0]
        s["E_commanded"] = s["E"]
        bench.y[:], bench.u[:] = ctl["y"][:NY], self._moving[0]["u_law"][:, j]
        ctl["u"] = bench.u
        stayed = {"true_omega_g": now["omega_g"], "true_V_g": now["V_g"], "law": ctl["active"]}
        for name, column in _columns(stretch).items():
            if name in stayed:
                column[stretch.start : k] = stayed[name]

    def run(self, ticks: int) -> tuple[int, list[int]]:
        """Run all lanes for up to ``ticks``; returns the ticks done, and the lanes that have to go
        on by themselves."""
        done, upset = _run_lanes(
            LANES, self._fixed, self._moving, self._before, self._used, self._columns,
            *self._kind, ticks,
        )  # fmt: skip
        self._columns += 8 * done
        return done, [j for j in range(LANES) if upset >> j & 1]


def _columns(stretch: Stretch) -> dict[str, NDArray[np.float64]]:
    """The columns that a run keeps in memory, up to the end of a stretch; none of a run that has
    them elsewhere."""
    parts = stretch.those.plant_parts[0], stretch.those.controller_parts[0]
    return {
        name: column
        for part in parts
        if isinstance(part, MemoryPart) and part.signals is None
        for name, column in part.by_name(stretch.stop).items()
    }


def _copied(bench: Bench) -> Iterator[tuple[NDArray[np.int64], *_Places]]:
    """The words of each of a run's records, with the `_places` of those that a lane has."""
    plant, c = bench.plant, bench.controller
    k, parts = int(c.ctl[0]["active"]), int(plant.net[0]["n_parts"])
    law, state = c.laws[k : k + 1], c.states[k : k + 1]
    records = plant.par, plant.st, plant.net, plant.now, c.ctl, law, state
    for record, places in zip(records, _places(parts, *(r.dtype for r in records)), strict=True):
        yield np.ndarray(record.nbytes // 8, np.int64, record), *places


@lru_cache(maxsize=8)
def _places(parts: int, *kinds: np.dtype[np.void]) -> list[_Places]:
    """Which words of a run's records of these kinds are those of a lane: of each record the rows
    of the lane, the places in the record, and how many of both belong to what stays.

    All fields have 8 bytes. A lane is filled with records whose words are their own places.
    """
    lanes, ends = Lanes(), np.cumsum([kind.itemsize // 8 for kind in kinds])
    lanes._words[:], fixed, moving = -1, lanes._fixed[0], lanes._moving[0]
    words = np.split(np.arange(ends[-1]), ends[:-1])
    r, s, n, now, ctl, law, state = (w.view(kind)[0] for w, kind in zip(words, kinds, strict=True))
    for lane, record, names in (
        (fixed, r, (*_PLANT, *_SENSORS, *_DAC, "trip_limit")), (fixed, s, ("i_most",)),
        (fixed, law, _LAW), (fixed, ctl, ("y_low", "y_high")), (moving, ctl, ("y",)),
        (moving, s, ("tick", "x", "i_reg", "sensed", "u_now", "E", "E_most")),
    ):  # fmt: skip
        for name in names:
            to = lane[name][..., 0]
            to[...] = record[name][tuple(map(slice, to.shape))]
    fixed["half_h"][:parts, 0], fixed["age"][:parts, 0] = n["half_h"][:parts], n["age"][:, 0]
    fixed["lag_weights"][:parts, :, 0] = n["lag_weights"][:parts, 0]
    _put(fixed["rate"][..., 0], n["rate"][0])
    _put(fixed["drive"][..., 0], n["drive"][0, 0, :, 0])
    _put(fixed["decay_z"][..., 0].swapaxes(0, 1), n["decay"][0, :parts, :_MODES])
    _put(fixed["states"][..., 0].swapaxes(0, 1), n["states"][0, :_MODES, :_MODES])
    _put(fixed["grid_gain"][..., 0].swapaxes(0, 1), now["gain"][:parts, 1, :_MODES])
    _put(fixed["grid_turn"][..., 0], now["turn"][:parts, 1])
    fixed["omega_grid"][0], moving["E_q"][0] = now["omega_g"], s["u"][0, NU]
    moving["u"][..., 0] = s["u"][:, :NU]
    for name in ("z", "w", "unit"):
        _put(moving[name][..., 0], now[name])
    for name, of in _STATE.items():
        moving[name][:, 0] = state[of][: len(moving[name])]
    found, lane, stays = list[_Places](), lanes._words[:, 0], fixed_dtype.itemsize // (8 * LANES)
    for own in words:
        rows = np.flatnonzero((own[0] <= lane) & (lane <= own[-1]))
        found.append((rows, lane[rows] - own[0], int(np.searchsorted(rows, stays))))
    return found


def _put(parts: NDArray[np.float64], z: NDArray[np.complex128]) -> None:
    """Put z (n, ...) into real and imaginary parts, (2, m, ...): as many as both have."""
    z = z[: parts.shape[1]]
    parts[0, : len(z)], parts[1, : len(z)] = z.real, z.imag


def run_together(runs: Iterable[Steps[T]]) -> list[T]:
    """Have runs do all their ticks, those that fit side by side; returns what each returns, in
    their order. A run begins when there is a lane for it."""
    lanes, results = Lanes(), dict[int, T]()
    there: dict[int, tuple[int, Steps[T], Stretch]] = {}  # by lane
    at = [0] * LANES  # tick of each

    def go_on(j: int, which: int, run: Steps[T], k: int | None) -> None:
        """Tell a run that it is at tick k, None: it has not begun; until it enters lane j."""
        try:
            stretch = next(run) if k is None else run.send(k)
            while not lanes.enter(j, stretch):
                stretch = run.send(stretch.start)
            there[j], at[j] = (which, run, stretch), stretch.start
        except StopIteration as end:
            results[which] = end.value

    waiting, more = enumerate(runs), True
    while more or there:
        for j in range(LANES):
            while more and j not in there:
                if more := (one := next(waiting, None)) is not None:
                    go_on(j, *one, None)
        alone, done, upset = len(there) == 1, 0, list[int]()
        if len(there) > 1:  # one is quicker by itself
            done, upset = lanes.run(min(s.stop - at[j] for j, (_, _, s) in there.items()))
        for j, (which, run, stretch) in [*there.items()]:
            at[j] += done
            if alone or j in upset or at[j] == stretch.stop:
                lanes.leave(j, stretch, at[j])
                del there[j]
                go_on(j, which, run, at[j])
    return [results[k] for k in range(len(results))]


#: of a law's state, by their names here
_STATE = {"x_law": "x", "off": "offset", "u_law": "u", "trend": "trend", "seen_y": "y",
          "now": "now", "raw": "raw"}  # fmt: skip


def is_plain(bench: Bench) -> bool:
    """Whether a run's plant and law are such as lanes know."""
    r, n, laws = bench.plant.par[0], bench.plant.net[0], bench.controller.laws
    parts = int(n["n_parts"])
    return bool(
        n["n_converters"] == 1 and n["n_states"] == _MODES and n["n_modes"][0] == _MODES
        and parts <= _PARTS and (n["pieces"][:parts] == 1).all()
        and not (n["n_units"] or n["n_dynamic"] or n["connections"] or n["batteries"])
        and not (n["sparse"] or n["unbalanced"][0] or n["conversions"] > 1)
        and r["filtered"] and r["noisy"] and r["i_peak"] == math.inf and r["places"] == 0
        and r["dc_steps"] == 1 and r["tau_dc"] == 0 and r["energy"] == 0 and r["array"] == 0
        and r["chopper"][0] == 0 and r["delay"] > 0 and not bench.signal_set
        and (laws["n"] <= _ORDER).all() and (laws["error_map"] == LINEAR).all()
        and laws.dtype["A"].base == np.float64 and len(bench.trace.plan) == 0
    )  # fmt: skip


def _kind_of(bench: Bench) -> tuple[int, int] | None:
    """What the lanes of runs have to have in common: a law's order and the parts of a period; None
    if a run's next ticks are none of theirs."""
    if not is_plain(bench):
        return None
    plant, c = bench.plant, bench.controller
    s, n, now, ctl = plant.st[0], plant.net[0], plant.now[0], c.ctl[0]
    parts, omega = int(n["n_parts"]), now["omega_g"]
    calm = (
        s["trip"] == 0 and not s["crossed"].any() and (s["u"][:, NU + 1] < 0).all()
        and (s["u"][:, NU] == s["u"][0, NU]).all()
        and not (now["row"] or now["contact"] or now["joint"] or now["clearing"] or now["check"])
        and now["unbalance_left"] <= 0 and now["sag_left"] <= 0 and now["omega_g_slope"] == 0
        and now["omega_g_to"] == omega and now["V_g_to"] == now["V_g"]
        and (now["gain_omega"][:parts, 1] == omega).all()
        and ctl["state"] == RUNNING and ctl["request"] < 0 and ctl["stages"] == 0
        and not (ctl["joins"] or ctl["aligns"]) and (ctl["ref"] == ctl["ref_target"]).all()
    )  # fmt: skip
    order = int(c.laws["n"][int(ctl["active"])])
    return (order, parts) if calm else None
