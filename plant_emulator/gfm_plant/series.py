"""The exact solution of circuit and DC links between two edges of switched bridges, by its series.

Between two edges a switched bridge is a constant vector that stands still, times v_dc. So the
circuit, in the frame that stands still, and the DC links are one linear system with constant
coefficients, x' = A x + what the sources give, which turn at constant speeds. Its Taylor series

    x(t + tau h) = sum over j of c_j tau^j,  c_(j+1) = h/(j + 1) (A c_j + ...)

is exact to rounding with as many terms as h times the norm of A asks for. It holds for all tau in
[0, 1], so that it also says when a current becomes zero or a diode begins to conduct.

An unbalanced fault acts on two axes, on which the real and the imaginary parts of all space vectors
have rates of their own, see `circuit`; all vectors are then turned so that alpha is real.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gfm_plant.layout import TERMS, field
from gfm_plant.model import V_DC
from gfm_plant.records import PlantRecords
from gfm_plant.solution import I_F, I_O, V, grid_source, own, turned
from gfm_runtime.compiled import compiled, inlined

DC, REG, SOURCE, MID = 0, 1, 2, 3
"""Of a DC link: v_dc, the integral of its source's control, its source's current, and the midpoint.
Without a lag the source's current is what its control asks for."""

LARGEST = 1.0
"""Of the norm of A times the length of an interval; a longer one is cut."""

_SMALLEST = 1e-16  # p.u.; of the first term that is left out
_PER = np.array([1.0 / max(j, 1) for j in range(TERMS + 1)])  # 1 / j
_ENOUGH = np.array([(_SMALLEST * math.factorial(j + 1)) ** (1 / (j + 1)) for j in range(TERMS)])


@compiled
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
    stands = _stands(plant, at)
    to = stands * field(n, "axis")[c]
    for i in range(n.n_states):
        w[i] = w[i] * to
    for k in range(n.n_converters):
        plant.st[k].ahead = unit[k] * stands
    g, omega_g = grid_source(n), now.omega_g + 0.5 * n.T_s * now.omega_g_slope
    for k in range(2):
        E = now.sequence[k]
        source[g + k] = complex(now.V_g * E.real, now.V_g * E.imag) * unit[g + k] * to
        speed[g + k] = (omega_g if k == 0 else -omega_g) * n.omega_b


@compiled
def end_series(plant: PlantRecords, c: int, at: float, lasted: float) -> None:
    """Take w, the sources and the bridges' frames back to the common frame.

    Args:
        c, at: as for ``begin_series``.
        lasted: since then, s.
    """
    n, now = plant.net[0], plant.now[0]
    w, unit = field(now, "w"), field(now, "unit")
    back = _stands(plant, at + lasted).conjugate()
    to = back * field(n, "axis")[c].conjugate()
    for i in range(n.n_states):
        w[i] = w[i] * to
    for k in range(n.n_converters):
        unit[k] = normal(plant.st[k].ahead * back)
    g, speed = grid_source(n), field(now, "source_speed")
    for k in range(g, g + (2 if now.unbalance_left > 0.0 else 1)):
        unit[k] = normal(unit[k] * turned((speed[k] - n.omega_b) * lasted))


@inlined
def normal(u: complex) -> complex:
    """Return a unit phasor without its rounding."""
    length = 1.5 - 0.5 * (u.real * u.real + u.imag * u.imag)
    return complex(u.real * length, u.imag * length)


@inlined
def _stands(plant: PlantRecords, at: float) -> complex:
    """Return e^(j omega_b t) at an instant of the period."""
    n = plant.net[0]
    angle = n.omega_b * (n.T_s * plant.st[0].tick + at)
    return complex(math.cos(angle), math.sin(angle))


@inlined
def how_many(x: float) -> int:
    """Return how many terms the series needs for x = norm of A times h <= LARGEST."""
    j = 3
    while x > _ENOUGH[j] and j < TERMS - 1:
        j += 1
    return j


@compiled
def find_terms(plant: PlantRecords, c: int, h: float, terms: int, kept: bool) -> None:
    """Find the states in the middle and at the end of an interval of h s, from the present ones on.

    Args:
        plant, c: as for ``begin_series``.
        h: s.
        terms: as ``how_many`` says.
        kept: whether ``w_at`` and ``dc_at`` are to be called for other instants.
    """
    n = plant.net[0]
    if field(n, "alone")[c]:
        _find_alone(plant, c, h, terms, kept)
    else:
        _find_together(plant, c, h, terms)


@compiled
def _find_together(plant: PlantRecords, c: int, h: float, terms: int) -> None:
    """``find_terms`` in any circuit."""
    n, now = plant.net[0], plant.now[0]
    x, dc, w = field(now, "terms"), field(now, "dc_terms"), field(now, "w")
    source, s_term = field(now, "source"), field(now, "source_term")
    s_speed = field(now, "source_speed")
    n_links, link_place, link = field(n, "n_links"), field(n, "link_place"), field(n, "link")
    for i in range(n.n_states):
        x[0, i] = w[i]
    for k in range(n.n_converters):
        s = plant.st[k]
        dc[0, k, DC], dc[0, k, REG], dc[0, k, MID] = s.x[V_DC], s.i_reg, s.mid
        dc[0, k, SOURCE] = s.i_source
    for k in range(n.n_converters, now.n_s):
        s_term[k] = source[k]
    for j in range(1, terms + 1):
        d = h * _PER[j]
        for i in range(n.n_states):
            x[j, i] = 0j
        for k in range(n.n_converters):
            at = own(k)
            i, v, i_o = x[j - 1, at + I_F], x[j - 1, at + V], x[j - 1, at + I_O]
            (
                i_a, i_b, v_a, v_b, o_a, o_b,
                dc[j, k, DC], dc[j, k, REG], dc[j, k, SOURCE], dc[j, k, MID],
            ) = _own_term(
                _constants(plant, c, k), 1.0 if j == 1 else 0.0, d,
                i.real, i.imag, v.real, v.imag, i_o.real, i_o.imag,
                dc[j - 1, k, DC], dc[j - 1, k, REG], dc[j - 1, k, SOURCE], dc[j - 1, k, MID],
            )  # fmt: skip
            x[j, at + I_F] = complex(i_a, i_b)
            x[j, at + V] = complex(v_a, v_b)
            x[j, at + I_O] = complex(o_a, o_b)
        for e in range(n_links[c, 0]):
            row, column = link_place[c, 0, e, 0], link_place[c, 0, e, 1]
            y = x[j - 1, column]
            x[j, row] += complex(d * link[c, 0, e, 0] * y.real, d * link[c, 0, e, 1] * y.imag)
        for e in range(n_links[c, 1]):
            row, column = link_place[c, 1, e, 0], link_place[c, 1, e, 1]
            y = s_term[column]
            x[j, row] += complex(d * link[c, 1, e, 0] * y.real, d * link[c, 1, e, 1] * y.imag)
        for k in range(n.n_converters, now.n_s):
            y, turn = s_term[k], d * s_speed[k]
            s_term[k] = complex(-turn * y.imag, turn * y.real)
    w_to, dc_to = field(now, "w_to"), field(now, "dc_to")
    for which in range(2):
        tau = 0.5 if which == 0 else 1.0
        for i in range(n.n_states):
            w_to[which, i] = w_at(now, i, terms, tau)
        for k in range(n.n_converters):
            for what in range(4):
                dc_to[which, k, what] = dc_at(now, k, what, terms, tau)


@compiled
def _find_alone(plant: PlantRecords, c: int, h: float, terms: int, kept: bool) -> None:
    """``find_terms`` in a circuit of one converter whose line ends at the grid."""
    n, now, s = plant.net[0], plant.now[0], plant.st[0]
    x, dc, w = field(now, "terms"), field(now, "dc_terms"), field(now, "w")
    constants, g = _constants(plant, c, 0), grid_source(n)
    source, speed, link = field(now, "source"), field(now, "source_speed"), field(n, "link")
    i_a, i_b, v_a, v_b = w[I_F].real, w[I_F].imag, w[V].real, w[V].imag
    o_a, o_b = w[I_O].real, w[I_O].imag
    v_dc, reg, flow, mid = s.x[V_DC], s.i_reg, s.i_source, s.mid
    # of both sequences of the grid what it does to the current of the line
    by_a, by_b, turn = link[c, 1, 0, 0], link[c, 1, 0, 1], speed[g]
    p_a, p_b, n_a, n_b = source[g].real, source[g].imag, source[g + 1].real, source[g + 1].imag
    one, half = 1.0, 1.0
    if kept:
        x[0, I_F], x[0, V], x[0, I_O] = w[I_F], w[V], w[I_O]
        dc[0, 0, DC], dc[0, 0, REG], dc[0, 0, SOURCE], dc[0, 0, MID] = v_dc, reg, flow, mid
    m_va, m_vb, m_oa, m_ob, m_dc = v_a, v_b, o_a, o_b, v_dc  # in the middle
    m_ia, m_ib = i_a, i_b
    t_ia, t_ib, t_va, t_vb, t_oa, t_ob = i_a, i_b, v_a, v_b, o_a, o_b  # at the end
    t_dc, t_reg, t_flow, t_mid = v_dc, reg, flow, mid
    for j in range(1, terms + 1):
        d = h * _PER[j]
        i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg, flow, mid = _own_term(
            constants, one, d, i_a, i_b, v_a, v_b, o_a, o_b, v_dc, reg, flow, mid
        )
        o_a += d * by_a * (p_a + n_a)
        o_b += d * by_b * (p_b + n_b)
        p_a, p_b = -d * turn * p_b, d * turn * p_a
        n_a, n_b = d * turn * n_b, -d * turn * n_a
        if kept:
            x[j, I_F], x[j, V], x[j, I_O] = (
                complex(i_a, i_b), complex(v_a, v_b), complex(o_a, o_b)
            )  # fmt: skip
            dc[j, 0, DC], dc[j, 0, REG], dc[j, 0, SOURCE], dc[j, 0, MID] = v_dc, reg, flow, mid
        one = 0.0
        half *= 0.5
        m_ia, m_ib, m_dc = m_ia + half * i_a, m_ib + half * i_b, m_dc + half * v_dc
        m_va, m_vb = m_va + half * v_a, m_vb + half * v_b
        m_oa, m_ob = m_oa + half * o_a, m_ob + half * o_b
        t_ia, t_ib, t_va, t_vb = t_ia + i_a, t_ib + i_b, t_va + v_a, t_vb + v_b
        t_oa, t_ob, t_dc = t_oa + o_a, t_ob + o_b, t_dc + v_dc
        t_reg, t_flow, t_mid = t_reg + reg, t_flow + flow, t_mid + mid
    w_to, dc_to = field(now, "w_to"), field(now, "dc_to")
    w_to[0, I_F], w_to[0, V], w_to[0, I_O] = (
        complex(m_ia, m_ib), complex(m_va, m_vb), complex(m_oa, m_ob)
    )  # fmt: skip
    w_to[1, I_F], w_to[1, V], w_to[1, I_O] = (
        complex(t_ia, t_ib), complex(t_va, t_vb), complex(t_oa, t_ob)
    )  # fmt: skip
    dc_to[0, 0, DC] = m_dc
    dc_to[1, 0, DC], dc_to[1, 0, REG], dc_to[1, 0, SOURCE], dc_to[1, 0, MID] = (
        t_dc, t_reg, t_flow, t_mid
    )  # fmt: skip


@inlined
def _constants(plant: PlantRecords, c: int, k: int) -> Any:
    """Return what ``_own_term`` takes of converter k between two edges: of the bridge, of filter
    and line, and of the DC link, Eq. (8), whose source is between its limits or at one of them."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    q = field(n, "own_rates")[c, k]
    per_C = r.omega_b / r.C_dc
    free = 1.0 if s.limit == 0.0 else 0.0
    held = free * r.i_u_gain * s.u_now[0]
    if s.limit != 0.0:
        held += limit_of(s)
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
def w_at(now: Any, i: int, terms: int, tau: float) -> complex:
    """Return state i of w at a part tau of the interval."""
    x = field(now, "terms")
    y = x[terms, i]
    for j in range(terms - 1, -1, -1):
        y = complex(x[j, i].real + tau * y.real, x[j, i].imag + tau * y.imag)
    return y


@inlined
def dc_at(now: Any, k: int, what: int, terms: int, tau: float) -> float:
    """Return a state of converter k's DC link at a part tau of the interval."""
    x = field(now, "dc_terms")
    y = x[terms, k, what]
    for j in range(terms - 1, -1, -1):
        y = x[j, k, what] + tau * y
    return y
