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

from gfm_plant.layout import TERMS, field
from gfm_plant.model import V_DC
from gfm_plant.records import PlantRecords
from gfm_plant.solution import I_F, I_O, V, grid_source, own
from gfm_runtime.compiled import compiled, inlined

DC, REG, SOURCE, MID = 0, 1, 2, 3
"""Of a DC link: v_dc, the integral of its source's control, its source's current, and the midpoint.
Without a lag the source's current is what its control asks for."""

LARGEST = 1.0
"""Of the norm of A times the length of an interval; a longer one is cut."""

_SMALLEST = 1e-17  # p.u.; of the first term that is left out
_PER = tuple(1.0 / max(j, 1) for j in range(TERMS + 1))  # 1 / j


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
    turned = stands * field(n, "axis")[c]
    for i in range(n.n_states):
        w[i] = w[i] * turned
    for k in range(n.n_converters):
        plant.st[k].ahead = unit[k] * stands
    g, omega_g = grid_source(n), now.omega_g + 0.5 * n.T_s * now.omega_g_slope
    for k in range(2):
        E = now.sequence[k]
        source[g + k] = complex(now.V_g * E.real, now.V_g * E.imag) * unit[g + k] * turned
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
    turned = back * field(n, "axis")[c].conjugate()
    for i in range(n.n_states):
        w[i] = w[i] * turned
    for k in range(n.n_converters):
        unit[k] = normal(plant.st[k].ahead * back)
    g, speed = grid_source(n), field(now, "source_speed")
    for k in range(g, g + 2):
        angle = (speed[k] - n.omega_b) * lasted
        unit[k] = normal(unit[k] * complex(math.cos(angle), math.sin(angle)))


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
    j, size = 1, x
    while size > _SMALLEST and j < TERMS - 1:
        j += 1
        size *= x * _PER[j]
    return j


@compiled
def find_terms(plant: PlantRecords, c: int, h: float, terms: int) -> None:
    """Set the terms of the series for an interval of h s, from the present state on: ``terms``
    besides the state itself."""
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
            _own_term(plant, c, k, j, d)
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


@inlined
def _own_term(plant: PlantRecords, c: int, k: int, j: int, d: float) -> None:
    """Set term j of the states of converter k, by what it consists of alone."""
    n, now, r, s, at = plant.net[0], plant.now[0], plant.par[k], plant.st[k], own(k)
    x, dc, rates = field(now, "terms"), field(now, "dc_terms"), field(n, "own_rates")
    i, v, i_o = x[j - 1, at + I_F], x[j - 1, at + V], x[j - 1, at + I_O]
    v_dc, reg = dc[j - 1, k, DC], dc[j - 1, k, REG]
    flow, mid = dc[j - 1, k, SOURCE], dc[j - 1, k, MID]
    one = 1.0 if j == 1 else 0.0  # what is constant has no further terms
    di_v, di_i = s.di_v, s.di_i
    x[j, at + I_F] += complex(
        d * (
            one * s.di.real + s.di_dc.real * v_dc + s.di_mid.real * mid
            - di_v[0] * v.real - di_v[1] * v.imag - di_i[0] * i.real - di_i[1] * i.imag
        ),
        d * (
            one * s.di.imag + s.di_dc.imag * v_dc + s.di_mid.imag * mid
            - di_v[1] * v.real - di_v[2] * v.imag - di_i[2] * i.real - di_i[3] * i.imag
        ),
    )  # fmt: skip
    x[j, at + V] += complex(
        d
        * (rates[c, k, 0, 0] * i.real + rates[c, k, 0, 1] * v.real + rates[c, k, 0, 2] * i_o.real),
        d
        * (rates[c, k, 1, 0] * i.imag + rates[c, k, 1, 1] * v.imag + rates[c, k, 1, 2] * i_o.imag),
    )
    x[j, at + I_O] += complex(
        d * (rates[c, k, 0, 3] * v.real + rates[c, k, 0, 4] * i_o.real),
        d * (rates[c, k, 1, 3] * v.imag + rates[c, k, 1, 4] * i_o.imag),
    )
    # the DC link, Eq. (8), with its source between its limits or at one of them
    free = 1.0 if s.limit == 0.0 else 0.0
    error = one - v_dc
    asked = free * (one * r.i_u_gain * s.u_now[0] + r.k_p * error + reg)
    if s.limit != 0.0:
        asked += one * limit_of(s)
    gives = flow if r.tau_dc > 0.0 else asked
    per_C = r.omega_b / r.C_dc
    by_dc = (s.by_dc.real * i.real + s.by_dc.imag * i.imag) * r.current
    by_mid = (s.by_mid.real * i.real + s.by_mid.imag * i.imag) * r.current
    dc[j, k, DC] = d * per_C * (gives - by_dc - s.chopper * v_dc)
    dc[j, k, MID] = -d * per_C * by_mid
    dc[j, k, REG] = d * s.winds * r.k_i * error
    dc[j, k, SOURCE] = d * (asked - flow) / r.tau_dc if r.tau_dc > 0.0 else 0.0


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
