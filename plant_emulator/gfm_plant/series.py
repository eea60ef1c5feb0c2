"""The exact solution of circuit and DC links between two edges of switched bridges, by its series.

Between two edges a switched bridge is a constant vector that stands still, times v_dc. So the
circuit, in the frame that stands still, and the DC links are one linear system with constant
coefficients, x' = A x + what the sources give, which turn at constant speeds. Its Taylor series

    x(t + tau h) = sum over j of c_j tau^j,  c_(j+1) = h/(j + 1) (A c_j + ...)

is exact to rounding with as many terms as h times the norm of A asks for. It holds for all tau in
[0, 1], so that it also says when a current becomes zero or a diode begins to conduct. `powers` sums
it for one converter on its grid.

An unbalanced fault acts on two axes, on which the real and the imaginary parts of all space vectors
have rates of their own, see `circuit`; all vectors are then turned so that alpha is real.
"""

from typing import Any

import numpy as np

from gfm_plant.beside import average_rates, set_average
from gfm_plant.layout import ORDER, POWERS, TERMS, field
from gfm_plant.model import V_DC
from gfm_plant.phases import frame_turn
from gfm_plant.port import drive_by_itself, drive_port, keep_moments
from gfm_plant.powers import MID_AT, ONE, SMALL, SOURCE_AT, N, P, fill_powers, find_slot, go_to
from gfm_plant.records import I_F, I_O, N_PATH, PlantRecords, V
from gfm_plant.solution import grid_source, own
from gfm_plant.sparse import ENOUGH, how_many, turned
from gfm_runtime.compiled import compiled, inlined

DC, REG, SOURCE, MID = 6, 7, 8, 9
"""Places in ``ends`` of v_dc, the integral of its source's control, its source's current, and the
midpoint, behind i_f, v and i_o. Without a lag the source's current is what its control asks for."""

_PER = np.array([1.0 / max(j, 1) for j in range(TERMS + 1)])  # 1 / j
_TWO_LEVELS = ENOUGH[2 * POWERS - 1]


@inlined
def begin_series(plant: PlantRecords, c: int, at: float) -> None:
    """Take w, the sources and the bridges' frames from the common frame to that of a series.

    Args:
        c: the circuit in force.
        at: the instant, s after the beginning of the period.
    """
    n, now = plant.net[0], plant.now[0]
    w, unit, source, speed = (
        field(now, "w"), field(now, "unit"), field(now, "source"), field(now, "source_speed")
    )  # fmt: skip
    turn = frame_turn(plant, at)
    to = turn * field(n, "axis")[c]
    for i in range(n.n_states):
        w[i] = w[i] * to
    for k in range(n.n_converters):
        s = plant.st[k]
        s.ahead = unit[k] * turn
        for i in range(3):
            s.ends[0, 2 * i], s.ends[0, 2 * i + 1] = w[own(k) + i].real, w[own(k) + i].imag
        s.ends[0, DC], s.ends[0, SOURCE], s.ends[0, MID] = s.x[V_DC], s.i_source, s.mid
        s.ends[0, REG] = s.i_reg + plant.par[k].i_u_gain * s.u_now[0]
        if plant.par[k].levels == 0:
            set_average(plant, k, c)
    g, omega_g = grid_source(n), now.omega_g + 0.5 * n.T_s * now.omega_g_slope
    for k in range(2):
        E = now.sequence[k]
        source[g + k] = complex(now.V_g * E.real, now.V_g * E.imag) * unit[g + k] * to
        speed[g + k] = (omega_g if k == 0 else -omega_g) * n.omega_b
    for k in range(g + 2, now.n_s):  # of components, which set their speeds, see `moving`
        source[k] = source[k] * to
    if field(n, "alone")[c]:
        r, s, x = plant.par[0], plant.st[0], field(now, "vector")
        few = r.tau_dc == 0.0 and r.levels < 3 and source[g + 1] == 0j
        now.order = SMALL if few else ORDER
        for j in range(REG + 1):
            x[0, j] = s.ends[0, j]
        x[0, ONE], x[0, SOURCE_AT], x[0, MID_AT] = 1.0, s.i_source, s.mid
        x[0, P], x[0, P + 1] = source[g].real, source[g].imag
        x[0, N], x[0, N + 1] = source[g + 1].real, source[g + 1].imag


@inlined
def end_series(plant: PlantRecords, c: int, at: float, lasted: float) -> None:
    """Take w, the sources and the bridges' frames back to the common frame.

    Args:
        c, at: as for ``begin_series``.
        lasted: since then, s.
    """
    n, now = plant.net[0], plant.now[0]
    w, unit = field(now, "w"), field(now, "unit")
    back = frame_turn(plant, at + lasted).conjugate()
    to = back * field(n, "axis")[c].conjugate()
    for k in range(n.n_converters):
        s = plant.st[k]
        unit[k] = normal(s.ahead * back)
        if plant.par[k].levels > 0:
            s.x[V_DC], s.i_source, s.mid = s.ends[0, DC], s.ends[0, SOURCE], s.ends[0, MID]
            s.i_reg = s.ends[0, REG] - plant.par[k].i_u_gain * s.u_now[0]
        for i in range(3):
            w[own(k) + i] = complex(s.ends[0, 2 * i], s.ends[0, 2 * i + 1])
    for i in range(n.n_states):
        w[i] = w[i] * to
    g, speed = grid_source(n), field(now, "source_speed")
    for k in range(g, g + (2 if now.unbalance_left > 0.0 else 1)):
        unit[k] = normal(unit[k] * turned((speed[k] - n.omega_b) * lasted))


@inlined
def normal(u: complex) -> complex:
    """Return a unit phasor without its rounding."""
    length = 1.5 - 0.5 * (u.real * u.real + u.imag * u.imag)
    return complex(u.real * length, u.imag * length)


@compiled
def hold_current(plant: PlantRecords, k: int, c: int, i: complex) -> None:
    """Set the current of L_f of converter k at the beginning of an interval, p.u. of the
    network."""
    s = plant.st[k]
    s.ends[0, 0], s.ends[0, 1] = i.real, i.imag
    if field(plant.net[0], "alone")[c]:
        x = field(plant.now[0], "vector")
        x[0, 0], x[0, 1] = i.real, i.imag


@inlined
def find_terms(plant: PlantRecords, c: int, h: float, t: float) -> int:
    """Find the series of an interval of h s from the present states on, t s after the beginning of
    a unit, and where it leads to; returns how many terms of ``terms`` it has. `begin_powers` comes
    before."""
    n, now = plant.net[0], plant.now[0]
    if field(n, "alone")[c]:
        terms, s, x = 0, plant.st[0], field(now, "vector")
        for j in range(4):
            s.slopes[0, j] = x[1, 2 + j]
        _lead(plant, c, h)
    else:
        terms = how_many(h * field(n, "fastest")[c])
        if now.behind:
            drive_port(plant, h, t)
            if is_plain(plant, n.switched):
                _find_plain(plant, c, h, terms)
            else:
                _find_own(plant, c, h, terms)
            if not plant.par[n.switched].filtered:
                return terms
        else:
            _find_together(plant, c, h, terms)
        x_1 = field(now, "terms")
        for k in range(n.n_converters):
            s, per_h = plant.st[k], 1.0 / h
            if now.behind and k != n.switched:
                continue
            v, i_o = x_1[1, own(k) + V], x_1[1, own(k) + I_O]
            s.slopes[0, 0], s.slopes[0, 1] = per_h * v.real, per_h * v.imag
            s.slopes[0, 2], s.slopes[0, 3] = per_h * i_o.real, per_h * i_o.imag
            look(plant, k, c, h, terms, 1.0)
    return terms


@compiled
def find_path(plant: PlantRecords, k: int, c: int, h: float, terms: int) -> None:
    """Write the terms of tau, ..., tau^N_PATH of converter k's series of an interval to ``ends``,
    behind the ends."""
    now, s = plant.now[0], plant.st[k]
    if field(plant.net[0], "alone")[c]:
        x, d = field(now, "vector"), 1.0
        for j in range(1, N_PATH + 1):
            d *= h * _PER[j]
            for i in range(REG + 1):
                s.ends[1 + j, i] = d * x[j, i]
            s.ends[1 + j, SOURCE], s.ends[1 + j, MID] = 0.0, 0.0
            if now.order == ORDER:
                s.ends[1 + j, SOURCE], s.ends[1 + j, MID] = d * x[j, SOURCE_AT], d * x[j, MID_AT]
        return
    y, dc = field(now, "terms"), field(now, "dc_terms")
    for j in range(1, N_PATH + 1):
        there = j <= terms  # further terms are of another interval
        for i in range(3):
            z = y[j, own(k) + i] if there else 0j
            s.ends[1 + j, 2 * i], s.ends[1 + j, 2 * i + 1] = z.real, z.imag
        for what in range(4):
            s.ends[1 + j, DC + what] = dc[j, k, what] if there else 0.0


@inlined
def _lead(plant: PlantRecords, c: int, h: float) -> None:
    """Take ``ends`` of the only converter to h s after the beginning of the interval."""
    n = plant.net[0]
    levels = 2 if h * field(n, "fastest")[c] < _TWO_LEVELS else 3
    go_to(plant.now[0], plant.st[0].slot, h, levels)
    _read_powers(plant, c)


@inlined
def _read_powers(plant: PlantRecords, c: int) -> None:
    """Read where the powers lead to, and what changes there in a second."""
    n, now, s = plant.net[0], plant.now[0], plant.st[0]
    x = field(now, "vector")
    for j in range(REG + 1):
        s.ends[1, j] = x[POWERS, j]
    s.ends[1, SOURCE], s.ends[1, MID] = s.ends[0, SOURCE], s.ends[0, MID]
    if now.order == ORDER:
        s.ends[1, SOURCE], s.ends[1, MID] = x[POWERS, SOURCE_AT], x[POWERS, MID_AT]
    if not plant.par[0].filtered:
        return
    q, link = field(n, "own_rates"), field(n, "link")
    i_a, i_b, v_a, v_b, o_a, o_b = (
        x[POWERS, 0], x[POWERS, 1], x[POWERS, 2], x[POWERS, 3], x[POWERS, 4], x[POWERS, 5]
    )  # fmt: skip
    p_a, p_b = x[POWERS, P], x[POWERS, P + 1]
    if now.order == ORDER:
        p_a, p_b = p_a + x[POWERS, N], p_b + x[POWERS, N + 1]
    s.slopes[1, 0] = q[c, 0, 0, 0] * i_a + q[c, 0, 0, 1] * v_a + q[c, 0, 0, 2] * o_a
    s.slopes[1, 1] = q[c, 0, 1, 0] * i_b + q[c, 0, 1, 1] * v_b + q[c, 0, 1, 2] * o_b
    s.slopes[1, 2] = q[c, 0, 0, 3] * v_a + q[c, 0, 0, 4] * o_a + link[c, 1, 0, 0] * p_a
    s.slopes[1, 3] = q[c, 0, 1, 3] * v_b + q[c, 0, 1, 4] * o_b + link[c, 1, 0, 1] * p_b


@compiled
def look(plant: PlantRecords, k: int, c: int, h: float, terms: int, tau: float) -> None:
    """Take ``ends`` of converter k to a part tau of the interval."""
    n, now, s = plant.net[0], plant.now[0], plant.st[k]
    if field(n, "alone")[c]:
        _lead(plant, c, tau * h)
        return
    x, dc = field(now, "terms"), field(now, "dc_terms")
    for i in range(3):
        y, slope = x[terms, own(k) + i], x[terms, own(k) + i] * complex(terms, 0.0)
        for j in range(terms - 1, -1, -1):
            z = x[j, own(k) + i]
            y = complex(z.real + tau * y.real, z.imag + tau * y.imag)
            if j > 0:
                slope = complex(j * z.real + tau * slope.real, j * z.imag + tau * slope.imag)
        s.ends[1, 2 * i], s.ends[1, 2 * i + 1] = y.real, y.imag
        if i > 0:
            s.slopes[1, 2 * i - 2], s.slopes[1, 2 * i - 1] = slope.real / h, slope.imag / h
    if plant.par[k].levels == 0:  # its link follows, see `beside`
        return
    for what in range(4):
        value = dc[terms, k, what]
        for j in range(terms - 1, -1, -1):
            value = dc[j, k, what] + tau * value
        s.ends[1, DC + what] = value


@inlined
def is_plain(plant: PlantRecords, k: int) -> bool:
    """Return whether bridge k has two levels and no drops, and all its legs have a voltage."""
    r = plant.par[k]
    return bool(r.cancels and plant.st[k].open < 0 and r.levels == 2 and r.tau_dc == 0.0)


@inlined
def find_tangent(plant: PlantRecords, k: int, c: int) -> tuple[float, float, float, float, float]:
    """Return the current of L_f at the beginning of an interval, p.u. of the network, what it
    changes by in a second, and a bound of its second derivative there, of the only switched bridge;
    in a network of a plain one."""
    if field(plant.net[0], "alone")[c]:
        x = field(plant.now[0], "vector")
        return x[0, 0], x[0, 1], x[1, 0], x[1, 1], abs(x[2, 0]) + abs(x[2, 1])
    return plain_tangent(plant, k, c)


@inlined
def plain_tangent(plant: PlantRecords, k: int, c: int) -> tuple[float, float, float, float, float]:
    """``find_tangent`` of a plain bridge, by its voltage and ``ends``."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    q, by_v = field(n, "own_rates")[c, k, 0], r.omega_b / (r.L_f * r.current)
    by_i = by_v * r.R_f * r.current
    i_a, i_b, v_a, v_b, o_a, o_b, v_dc = (
        s.ends[0, 0], s.ends[0, 1], s.ends[0, 2], s.ends[0, 3], s.ends[0, 4], s.ends[0, 5],
        s.ends[0, DC],
    )  # fmt: skip
    di_a = by_v * (s.by_dc.real * v_dc - v_a) - by_i * i_a
    di_b = by_v * (s.by_dc.imag * v_dc - v_b) - by_i * i_b
    dv_a = q[0] * i_a + q[1] * v_a + q[2] * o_a
    dv_b = q[0] * i_b + q[1] * v_b + q[2] * o_b
    return i_a, i_b, di_a, di_b, by_v * (abs(dv_a) + abs(dv_b)) + by_i * (abs(di_a) + abs(di_b))


@inlined
def bend(plant: PlantRecords, k: int, c: int, h: float) -> float:
    """Return by how much the current of L_f may differ from a straight line in the interval, p.u.
    of the network: twice what its second derivative at the beginning gives."""
    now = plant.now[0]
    if field(plant.net[0], "alone")[c]:
        x = field(now, "vector")
        return 0.25 * h * h * (abs(x[2, 0]) + abs(x[2, 1]))
    x_2 = field(now, "terms")[2, own(k) + I_F]
    return 0.5 * (abs(x_2.real) + abs(x_2.imag))


@inlined
def accept(plant: PlantRecords, c: int, h: float, t: float, terms: int, tau: float) -> None:
    """Take the states on to where ``ends`` lead, a part tau of an interval of h s from t on."""
    n, now = plant.net[0], plant.now[0]
    if field(n, "alone")[c]:
        x = field(now, "vector")
        for j in range(ORDER):
            x[0, j] = x[POWERS, j]
    elif now.behind:
        keep_moments(plant, h, t, terms, tau)
    else:
        x, w = field(now, "terms"), field(now, "w")
        source, speed = field(now, "source"), field(now, "source_speed")
        for i in range(own(n.n_converters), n.n_states):
            y = x[terms, i]
            for j in range(terms - 1, -1, -1):
                y = complex(x[j, i].real + tau * y.real, x[j, i].imag + tau * y.imag)
            w[i] = y
        for k in range(now.n_s):
            source[k] = source[k] * turned(speed[k] * tau * h)
    for k in range(n.n_converters):
        s = plant.st[k]
        if now.behind and k != n.switched:
            continue
        for j in range(MID + 1):
            s.ends[0, j] = s.ends[1, j]


@compiled
def _find_own(plant: PlantRecords, c: int, h: float, terms: int) -> None:
    """``find_terms`` of the only switched bridge of a network, see `port`, with where it leads."""
    n, now = plant.net[0], plant.now[0]
    k = n.switched
    r, s, at = plant.par[k], plant.st[k], own(k)
    x, dc, ends = field(now, "terms"), field(now, "dc_terms"), s.ends
    g, E = field(now, "port_g"), field(now, "port_E")
    constants = _constants(plant, c, k)
    per, R = r.L_f * r.current / (r.omega_b * h), r.R_f * r.current
    for j in range(MID + 1):
        ends[1, j] = ends[0, j]
    i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg, flow, mid = (
        ends[0, 0], ends[0, 1], ends[0, 2], ends[0, 3], ends[0, 4], ends[0, 5],
        ends[0, DC], ends[0, REG], ends[0, SOURCE], ends[0, MID],
    )  # fmt: skip
    for j in range(terms + 1):
        if j > 0:
            E_a, E_b, d = v_a + R * i_a, v_b + R * i_b, h * _PER[j]
            i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg, flow, mid = _own_term(
                constants, 1.0 if j == 1 else 0.0, d,
                i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg, flow, mid,
            )  # fmt: skip
            o_a += d * g[0, j - 1]
            o_b += d * g[1, j - 1]
            E[0, j - 1], E[1, j - 1] = E_a + j * per * i_a, E_b + j * per * i_b
            if j < terms - 2:
                drive_by_itself(plant, h, terms, j - 1)
            ends[1, 0] += i_a
            ends[1, 1] += i_b
            ends[1, 2] += v_a
            ends[1, 3] += v_b
            ends[1, 4] += o_a
            ends[1, 5] += o_b
            ends[1, DC] += v_dc
            ends[1, REG] += reg
            ends[1, SOURCE] += flow
            ends[1, MID] += mid
        x[j, at + I_F], x[j, at + V], x[j, at + I_O] = (
            complex(i_a, i_b), complex(v_a, v_b), complex(o_a, o_b)
        )  # fmt: skip
        dc[j, k, 0], dc[j, k, 1], dc[j, k, 2], dc[j, k, 3] = v_dc, reg, flow, mid


@inlined
def _find_plain(plant: PlantRecords, c: int, h: float, terms: int) -> None:
    """``_find_own`` of a bridge of two levels without drops, all of whose legs have a voltage; it
    is by_dc v_dc."""
    n, now = plant.net[0], plant.now[0]
    k = n.switched
    r, s, at, q = plant.par[k], plant.st[k], own(k), field(n, "own_rates")[c, n.switched]
    x, dc, ends = field(now, "terms"), field(now, "dc_terms"), s.ends
    g, E, e_a, e_b = field(now, "port_g"), field(now, "port_E"), s.by_dc.real, s.by_dc.imag
    per_C, per_L = r.omega_b / r.C_dc, s.di_v[0]
    by_i, vi, vv, vo, ov, oo = s.di_i[0], q[0, 0], q[0, 1], q[0, 2], q[0, 3], q[0, 4]
    free, held, drawn, k_i = 1.0, 0.0, -per_C * r.current, s.winds * r.k_i
    if s.limit != 0.0:
        free, held = 0.0, limit_of(s)
    by_v, by_reg, fixed = -per_C * (free * r.k_p + s.chopper), per_C * free, held + free * r.k_p
    fixed *= per_C
    i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg = (
        ends[0, 0], ends[0, 1], ends[0, 2], ends[0, 3], ends[0, 4], ends[0, 5],
        ends[0, DC], ends[0, REG],
    )  # fmt: skip
    flow, mid, integrates = ends[0, SOURCE], ends[0, MID], k_i
    ends[1, SOURCE], ends[1, MID] = flow, mid
    i_a_to, i_b_to, v_a_to, v_b_to, o_a_to, o_b_to, v_dc_to, reg_to = (
        i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg
    )  # fmt: skip
    for j in range(terms + 1):
        x[j, at + I_F], x[j, at + V], x[j, at + I_O] = (
            complex(i_a, i_b), complex(v_a, v_b), complex(o_a, o_b)
        )  # fmt: skip
        dc[j, k, 0], dc[j, k, 1], dc[j, k, 2], dc[j, k, 3] = v_dc, reg, flow, mid
        E[0, j], E[1, j] = e_a * v_dc, e_b * v_dc
        if j == terms:
            break
        if j < terms - 3:
            drive_by_itself(plant, h, terms, j)
        d = h * _PER[j + 1]
        i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg = (
            d * (per_L * (e_a * v_dc - v_a) - by_i * i_a),
            d * (per_L * (e_b * v_dc - v_b) - by_i * i_b),
            d * (vi * i_a + vv * v_a + vo * o_a),
            d * (vi * i_b + vv * v_b + vo * o_b),
            d * (ov * v_a + oo * o_a + g[0, j]),
            d * (ov * v_b + oo * o_b + g[1, j]),
            d * ((by_v * v_dc + by_reg * reg + fixed) + drawn * (e_a * i_a + e_b * i_b)),
            d * (integrates - k_i * v_dc),
        )  # fmt: skip
        flow = mid = fixed = integrates = 0.0
        i_a_to += i_a
        i_b_to += i_b
        v_a_to += v_a
        v_b_to += v_b
        o_a_to += o_a
        o_b_to += o_b
        v_dc_to += v_dc
        reg_to += reg
    ends[1, 0], ends[1, 1], ends[1, 2], ends[1, 3], ends[1, 4], ends[1, 5] = (
        i_a_to, i_b_to, v_a_to, v_b_to, o_a_to, o_b_to
    )  # fmt: skip
    ends[1, DC], ends[1, REG] = v_dc_to, reg_to


@compiled
def _find_together(plant: PlantRecords, c: int, h: float, terms: int) -> None:
    """``find_terms`` in any circuit."""
    n, now = plant.net[0], plant.now[0]
    x, dc, w = field(now, "terms"), field(now, "dc_terms"), field(now, "w")
    source, s_term = field(now, "source"), field(now, "source_term")
    s_speed = field(now, "source_speed")
    for i in range(own(n.n_converters), n.n_states):
        x[0, i] = w[i]
    for k in range(n.n_converters):
        s = plant.st[k]
        for i in range(3):
            x[0, own(k) + i] = complex(s.ends[0, 2 * i], s.ends[0, 2 * i + 1])
        for what in range(4):
            dc[0, k, what] = s.ends[0, DC + what]
    for k in range(now.n_s):
        s_term[k] = source[k]
    for j in range(1, terms + 1):
        d = h * _PER[j]
        for i in range(n.n_states):
            x[j, i] = 0j
        for k in range(n.n_converters):
            at = own(k)
            i, v, i_o = x[j - 1, at + I_F], x[j - 1, at + V], x[j - 1, at + I_O]
            if plant.par[k].levels == 0:
                _average_term(plant, c, k, j, d)
                continue
            (
                i_a, i_b, v_a, v_b, o_a, o_b,
                dc[j, k, 0], dc[j, k, 1], dc[j, k, 2], dc[j, k, 3],
            ) = _own_term(
                _constants(plant, c, k), 1.0 if j == 1 else 0.0, d,
                i.real, i.imag, v.real, v.imag, i_o.real, i_o.imag,
                dc[j - 1, k, 0], dc[j - 1, k, 1], dc[j - 1, k, 2], dc[j - 1, k, 3],
            )  # fmt: skip
            x[j, at + I_F] = complex(i_a, i_b)
            x[j, at + V] = complex(v_a, v_b)
            x[j, at + I_O] = complex(o_a, o_b)
        _add_links(n, now, c, 0, d, x[j - 1], x[j])
        _add_links(n, now, c, 1, d, s_term, x[j])
        for k in range(now.n_s):
            y, turn = s_term[k], d * s_speed[k]
            s_term[k] = complex(-turn * y.imag, turn * y.real)


@inlined
def _average_term(plant: PlantRecords, c: int, k: int, j: int, d: float) -> None:
    """Write term j of the own states of a converter whose bridge is averaged."""
    n, now = plant.net[0], plant.now[0]
    x, E, q = field(now, "terms"), field(now, "source_term")[k], field(n, "own_rates")
    at = own(k)
    i, v, i_o = x[j - 1, at + I_F], x[j - 1, at + V], x[j - 1, at + I_O]
    by_v, by_i = average_rates(plant.par[k], plant.st[k])
    x[j, at + I_F] = complex(
        d * (by_v * (E.real - v.real) - by_i * i.real),
        d * (by_v * (E.imag - v.imag) - by_i * i.imag),
    )
    x[j, at + V] = complex(
        d * (q[c, k, 0, 0] * i.real + q[c, k, 0, 1] * v.real + q[c, k, 0, 2] * i_o.real),
        d * (q[c, k, 1, 0] * i.imag + q[c, k, 1, 1] * v.imag + q[c, k, 1, 2] * i_o.imag),
    )
    x[j, at + I_O] = complex(
        d * (q[c, k, 0, 3] * v.real + q[c, k, 0, 4] * i_o.real),
        d * (q[c, k, 1, 3] * v.imag + q[c, k, 1, 4] * i_o.imag),
    )


@inlined
def _add_links(n: Any, now: Any, c: int, which: int, d: float, last: Any, to: Any) -> None:
    """Add to the next terms of w what the entries of w' = A w, or of B s, make of the last ones.

    The entries are in the order of their rows, so that a row adds up in registers. What one axis
    does to the other is there only with several contacts.
    """
    place, link, e = field(n, "link_place"), field(n, "link"), 0
    count = field(n, "n_links")[c, which]
    while e < count:
        row, alpha, beta = place[c, which, e, 0], 0.0, 0.0
        while e < count and place[c, which, e, 0] == row:
            y = last[place[c, which, e, 1]]
            alpha += link[c, which, e, 0] * y.real
            beta += link[c, which, e, 1] * y.imag
            if now.joint:
                alpha += link[c, which, e, 2] * y.imag
                beta += link[c, which, e, 3] * y.real
            e += 1
        to[row] += complex(d * alpha, d * beta)


@inlined
def _constants(plant: PlantRecords, c: int, k: int) -> Any:
    """Return what ``_own_term`` takes of converter k between two edges: of the bridge, of filter
    and line, and of the DC link, Eq. (8), whose source is between its limits or at one of them."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    q = field(n, "own_rates")[c, k]
    per_C = r.omega_b / r.C_dc
    free, held = 1.0, 0.0
    if s.limit != 0.0:
        free, held = 0.0, limit_of(s)
    per_lag, quick = 0.0, 1.0
    if r.tau_dc > 0.0:
        per_lag, quick = 1.0 / r.tau_dc, 0.0
    drawn = -per_C * r.current
    return (
        s.di.real, s.di.imag, s.di_dc.real, s.di_dc.imag, s.di_mid.real, s.di_mid.imag,
        s.di_v[0], s.di_v[1], s.di_v[2], s.di_i[0], s.di_i[1], s.di_i[2], s.di_i[3],
        q[0, 0], q[0, 1], q[0, 2], q[0, 3], q[0, 4], q[1, 0], q[1, 1], q[1, 2], q[1, 3], q[1, 4],
        drawn * s.by_dc.real, drawn * s.by_dc.imag, drawn * s.by_mid.real, drawn * s.by_mid.imag,
        per_C, s.chopper, held, free * r.k_p, free, s.winds * r.k_i, per_lag, quick,
    )  # fmt: skip


@inlined
def _own_term(
    constants: Any, one: float, d: float,
    i_a: float, i_b: float, v_a: float, v_b: float, o_a: float, o_b: float,
    v_dc: float, reg: float, flow: float, mid: float,
) -> Any:  # fmt: skip
    """Return the next term of a converter's own states by the last one of these; ``one`` is 1 for
    the first, as what is constant has no further ones."""
    (
        f_a, f_b, dc_a, dc_b, mid_a, mid_b, v_aa, v_ab, v_bb, i_aa, i_ab, i_ba, i_bb,
        vi_a, vv_a, vo_a, ov_a, oo_a, vi_b, vv_b, vo_b, ov_b, oo_b,
        drawn_a, drawn_b, mid_by_a, mid_by_b, per_C, chopper, held, k_p, free, k_i, per_lag, quick,
    ) = constants  # fmt: skip
    error = one - v_dc
    asked = one * held + k_p * error + free * reg
    gives = quick * asked + (1.0 - quick) * flow
    return (
        d * ((one * f_a + dc_a * v_dc + mid_a * mid)
             - (v_aa * v_a + v_ab * v_b) - (i_aa * i_a + i_ab * i_b)),
        d * ((one * f_b + dc_b * v_dc + mid_b * mid)
             - (v_ab * v_a + v_bb * v_b) - (i_ba * i_a + i_bb * i_b)),
        d * (vi_a * i_a + vv_a * v_a + vo_a * o_a),
        d * (vi_b * i_b + vv_b * v_b + vo_b * o_b),
        d * (ov_a * v_a + oo_a * o_a),
        d * (ov_b * v_b + oo_b * o_b),
        d * (per_C * (gives - chopper * v_dc) + (drawn_a * i_a + drawn_b * i_b)),
        d * k_i * error,
        d * per_lag * (asked - flow),
        d * (mid_by_a * i_a + mid_by_b * i_b),
    )  # fmt: skip


@inlined
def limit_of(s: Any) -> float:
    """Return the current at which the DC source is held; nothing flows from that of a blocked
    bridge."""
    if s.trip != 0:
        return 0.0
    return s.i_most[0] if s.limit > 0.0 else s.i_most[1]


@inlined
def choose_powers(plant: PlantRecords, c: int, key: int) -> bool:
    """Have the only converter use the powers of a key; returns whether they are to be filled."""
    now, s = plant.now[0], plant.st[0]
    s.slot, there = find_slot(now, key)
    made_for, speed = field(now, "slot_for"), field(now, "source_speed")[grid_source(plant.net[0])]
    limit = 0.0 if s.limit == 0.0 else limit_of(s)
    if not there:
        made_for[s.slot, 0], made_for[s.slot, 1] = speed, limit
        return True
    s.by_dc = field(now, "slot_by_dc")[s.slot]
    A, r = field(now, "power"), plant.par[0]
    if made_for[s.slot, 1] != limit:
        made_for[s.slot, 1] = limit
        row, per = (SOURCE_AT, 1.0 / r.tau_dc) if r.tau_dc > 0.0 else (DC, r.omega_b / r.C_dc)
        A[s.slot, 0, ONE, row] = per * limit
        fill_powers(now, s.slot, 1)
    if made_for[s.slot, 0] != speed:
        made_for[s.slot, 0] = speed
        _turn_grid(now, s.slot, speed)
        fill_powers(now, s.slot, 2)
    return False


@inlined
def _turn_grid(now: Any, slot: int, speed: float) -> None:
    A = field(now, "power")
    A[slot, 0, P, P + 1], A[slot, 0, P + 1, P] = speed, -speed
    A[slot, 0, N, N + 1], A[slot, 0, N + 1, N] = -speed, speed


@compiled
def make_powers(plant: PlantRecords, c: int) -> None:
    """Make the matrix of the only converter, whose constants are set, and its powers."""
    n, now, s = plant.net[0], plant.now[0], plant.st[0]
    A, x, link = field(now, "power"), field(now, "vector"), field(n, "link")
    field(now, "slot_by_dc")[s.slot] = s.by_dc
    constants = _constants(plant, c, 0)
    for column in range(ORDER):
        for row in range(ORDER):
            A[s.slot, 0, column, row] = 0.0
        for j in range(ORDER):  # a unit vector; the row that `begin_powers` writes last
            x[POWERS, j] = 1.0 if j == column else 0.0
        (
            A[s.slot, 0, column, 0], A[s.slot, 0, column, 1], A[s.slot, 0, column, 2],
            A[s.slot, 0, column, 3], A[s.slot, 0, column, 4], A[s.slot, 0, column, 5],
            A[s.slot, 0, column, DC], A[s.slot, 0, column, REG],
            A[s.slot, 0, column, SOURCE_AT], A[s.slot, 0, column, MID_AT],
        ) = _own_term(
            constants, x[POWERS, ONE], 1.0, x[POWERS, 0], x[POWERS, 1], x[POWERS, 2], x[POWERS, 3],
            x[POWERS, 4], x[POWERS, 5], x[POWERS, DC], x[POWERS, REG],
            x[POWERS, SOURCE_AT], x[POWERS, MID_AT],
        )  # fmt: skip
    for column in (P, N):  # of both sequences of the grid what it does to the current of the line
        A[s.slot, 0, column, 4], A[s.slot, 0, column + 1, 5] = link[c, 1, 0, 0], link[c, 1, 0, 1]
    _turn_grid(now, s.slot, field(now, "source_speed")[grid_source(n)])
    fill_powers(now, s.slot, 0)


@inlined
def of_leg(n: Any, c: int, x: int, a: float, b: float) -> float:
    """Return the part of a space vector a + jb of circuit c along the axis of leg x."""
    axis = field(n, "leg_axis")[c, x]
    return axis.real * a + axis.imag * b
