"""Switched bridges: modulator, gates with dead time, diodes, and the period from edge to edge.

A topology is a table: for each state of the gates of a leg the least and the largest voltage that
the leg can have, as factors of v_dc and of the midpoint's displacement, and less or more by what
its devices drop. A current out of the leg meets the least one, a current into it the largest one:
with the upper switch on both are the upper rail; in the dead time they are the lower rail, by a
diode, and the upper one. A leg without current has any voltage between them, and no current flows
until the circuit would drive it beyond: then a diode, or a switch, conducts.

Even states of the gates are levels, the odd one above each is the dead time to the next one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.dc_link import discharge
from gfm_plant.layout import field
from gfm_plant.model import DELTA, V_DC, terminal
from gfm_plant.period import limit_voltage, take_command
from gfm_plant.records import COMPARE, N_GATES, PlantRecords
from gfm_plant.series import (
    DC,
    LARGEST,
    MID,
    REG,
    SOURCE,
    begin_series,
    dc_at,
    end_series,
    find_terms,
    how_many,
    limit_of,
    normal,
    w_at,
)
from gfm_plant.solution import I_F, I_O, V, circuit, grid_source, integrals, own, turned
from gfm_runtime.compiled import compiled, inlined

_A = np.array([1.0, complex(-0.5, math.sqrt(0.75)), complex(-0.5, -math.sqrt(0.75))])
_NONE = 1e-12  # p.u.; a current that is no more is none
_NOW = 1e-15  # s; an edge that is no further away is now
_EVENTS = 200  # of one unit of the carrier; then currents may pass zero unseen
_TRIES = 100
_CLOSE = 1e-15  # p.u.; what is watched happens where it is no further from zero
LEVELS = {"two-level": (2, 1)}
"""Of a leg, by kind, and the state of its gates that blocks it."""

# what ends an interval before its time: + the leg, its current is zero; it begins to conduct
# outwards, or inwards; + 3 * outwards + inwards, two legs begin to; the DC source's limit
_NOTHING, _ZERO, _OUT, _IN, _PAIR, _LIMIT = -1, 0, 3, 6, 9, 20


def bands(kind: str, drops: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Return the table of a topology, (N_GATES, 2, 4); see ``band`` in `gfm_plant.records`.

    Args:
        kind: a key of ``LEVELS``.
        drops: thresholds of switch and diode, p.u. of v_dc, and their resistances, p.u.
    """
    V_s, V_d, R_s, R_d = drops
    least, most = np.zeros(4), np.array([1.0, 0.0, 0.0, 0.0])
    switch, diode = np.array([0, 0, V_s, R_s]), np.array([0, 0, V_d, R_d])
    sign = np.array([1, 1, -1, 1])  # outwards a threshold lowers the leg's voltage
    found = np.zeros((N_GATES, 2, 4))
    for gate, (by_out, by_in) in enumerate(
        [
            ((least, diode), (least, switch)),  # the lower one is on
            ((least, diode), (most, diode)),
            ((most, switch), (most, diode)),
        ]
    ):
        found[gate] = by_out[0] + sign * by_out[1], by_in[0] + by_in[1]
    return found


@compiled
def modulate(r: Any, s: Any, E: complex, v_dc: float) -> tuple[int, int, int]:
    """Return the compare counts of three legs that give the voltage E, a space vector in p.u. that
    stands still, on average: what ideal firmware does.

    They are those of space-vector modulation: the largest and the smallest of the three voltages
    lie evenly around the middle of v_dc. What v_dc cannot give is cut off in each leg, which ends
    in six steps.
    """
    per_leg = 1.0 / (1.5 * r.leg * v_dc)
    a, b, c = _along(0, E) * per_leg, _along(1, E) * per_leg, _along(2, E) * per_leg
    middle = 0.5 - 0.5 * (max(a, b, c) + min(a, b, c))
    return _count(r, a + middle), _count(r, b + middle), _count(r, c + middle)


@inlined
def _count(r: Any, share: float) -> int:
    """Return the compare value of a leg whose mean voltage is this share of v_dc."""
    whole = r.levels - 1
    share = min(max(share, 0.0), 1.0) * whole
    base = min(int(share), whole - 1)
    on = int((share - base) * r.counts + 0.5)
    if r.least > 0:  # half a pulse
        if on < r.least:
            on = r.least if 2 * on > r.least else 0
        elif r.counts - on < r.least:
            on = r.counts - r.least if 2 * (r.counts - on) > r.least else r.counts
    return base * r.counts + on


@inlined
def _taken(r: Any, s: Any, x: int) -> int:
    """Return the compare value of leg x that came with the command that acts."""
    return int(min(max(s.u_now[COMPARE + x], 0.0), 1.0 * r.counts * (r.levels - 1)))


@inlined
def _along(x: int, z: complex) -> float:
    """Return the part of a space vector along the axis of leg x."""
    return _A[x].real * z.real + _A[x].imag * z.imag


@compiled
def advance_bridges(plant: PlantRecords, begin: float, end: float) -> None:
    """Go on between two instants of the period, s after its beginning; inf: to its end."""
    n, now = plant.net[0], plant.now[0]
    end = min(end, n.T_s)
    if not begin < end:
        return
    c = circuit(n, now)
    begin_series(plant, c, begin)
    speed = field(now, "source_speed")[grid_source(n)]
    for unit in range(n.n_units):
        first = unit * n.unit_s
        last = n.T_s if unit == n.n_units - 1 else first + n.unit_s
        if first < end and begin < last:
            if begin <= first:
                for k in range(n.n_converters):
                    _load(plant, k, unit)
            a, b = max(begin, first) - first, min(end, last) - first
            _go(plant, c, a, b)
            for k in range(n.n_converters):
                s = plant.st[k]
                s.ahead = normal(s.ahead * turned(n.omega_b * s.u_now[1] * (b - a)))
                s.x[DELTA] += (b - a) * (n.omega_b * s.u_now[1] - speed)
            if last <= end:
                for k in range(n.n_converters):
                    s = plant.st[k]
                    for x in range(3):
                        s.on_at[x] -= n.unit_s
    end_series(plant, c, begin, end - begin)


@compiled
def _load(plant: PlantRecords, k: int, unit: int) -> None:
    """Begin a unit of the carrier: take the command that acts, and load compare values."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    take_command(plant, k, field(n, "unit_part")[unit])
    _watch_source(r, s)
    if s.trip != 0:
        for x in range(3):
            s.gate[x], s.level[x], s.base[x] = r.off, -1, -1
            s.edges[x, 0] = s.edges[x, 1] = s.on_at[x] = math.inf
        s.E[0] = s.E[1] = 0.0
        return
    limit_voltage(s, r.m_max * s.x[V_DC])
    half = turned(0.5 * n.omega_b * s.u_now[1] * n.unit_s)
    E = complex(s.E[0], s.E[1]) * s.ahead * half
    counts = modulate(r, s, E, s.x[V_DC])
    if not s.u_now[COMPARE] < 0.0:  # those of the controller
        counts = _taken(r, s, 0), _taken(r, s, 1), _taken(r, s, 2)
    down = n.updates == 2 and unit % 2 == 1  # the second half of the carrier's period
    for x in range(3):
        base = min(counts[x] // r.counts, r.levels - 2)
        on = counts[x] - base * r.counts
        s.base[x] = base
        s.edges[x, 0] = -1.0 if down else on * r.count_s
        s.edges[x, 1] = math.inf if n.updates == 2 else (2 * r.counts - on) * r.count_s
        if down:
            s.edges[x, 1] = (r.counts - on) * r.count_s
        if on == r.counts:  # it stays above
            s.edges[x, 0] = math.inf


@inlined
def _watch_source(r: Any, s: Any) -> None:
    """Set between which limits the DC source's control is, and whether its integral goes on."""
    if s.trip != 0:
        s.limit, s.winds = 1.0, 0.0
        return
    asked = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - s.x[V_DC]) + s.i_reg
    s.limit = 1.0 if asked > s.i_most[0] else (-1.0 if asked < s.i_most[1] else 0.0)
    s.winds = 0.0 if s.limit * (1.0 - s.x[V_DC]) > 0.0 else 1.0


@compiled
def _go(plant: PlantRecords, c: int, begin: float, end: float) -> None:
    """Go on from edge to edge, between two instants of a unit, s after its beginning."""
    n, t, events = plant.net[0], begin, 0
    longest = LARGEST / field(n, "fastest")[c]
    for k in range(n.n_converters):
        if plant.par[k].filtered:
            w = field(plant.now[0], "w")
            _see(plant.par[k], plant.st[k], 0, w[own(k) + V], w[own(k) + I_O])
    while True:
        until, watched = min(end, t + longest), False
        for k in range(n.n_converters):
            r, s = plant.par[k], plant.st[k]
            changed = t == begin
            for x in range(3):
                e_0, e_1 = s.edges[x, 0], s.edges[x, 1]
                level = s.base[x] + (1 if t < e_0 or t >= e_1 else 0)
                if level != s.level[x] and s.base[x] >= 0:
                    _command(r, s, x, level, t)
                    changed = True
                while s.on_at[x] <= t + _NOW:
                    _turn_on(r, s, x, t)
                    changed = True
                edge = e_0 if t < e_0 else (e_1 if t < e_1 else math.inf)
                until = min(until, edge, s.on_at[x])
            if changed:
                _settle(plant, k, c)
            watched = watched or s.open >= 0 or _flows(s) or r.i_max < math.inf or r.energy > 0.0
        if t >= end:
            return
        h = until - t
        terms = how_many(h * field(n, "fastest")[c])
        find_terms(plant, c, h, terms, watched)
        tau, which, what = 1.0, -1, _NOTHING
        if watched and events < _EVENTS:
            tau, which, what = _first_event(plant, c, terms)
        if tau < 1.0:
            _cut(plant, terms, tau)
        _take(plant, tau * h)
        t = until if tau == 1.0 else t + tau * h
        if what != _NOTHING:
            events += 1
            _change(plant, which, c, what)


@inlined
def _flows(s: Any) -> bool:
    """Return whether the sign of a current decides on the voltage of its leg."""
    return s.flows[0] != 0 or s.flows[1] != 0 or s.flows[2] != 0


@compiled
def _command(r: Any, s: Any, x: int, level: int, t: float) -> None:
    """Begin to bring leg x to a level: what is on turns off at once."""
    s.level[x] = level
    gate, wanted = s.gate[x], 2 * level
    if r.dead == 0.0 or (gate == r.off and gate % 2 == 1 and r.levels > 2):
        s.gate[x], s.on_at[x] = wanted, math.inf
    elif gate % 2 == 1:
        s.on_at[x] = t + r.dead
    elif gate != wanted:
        s.gate[x] = gate + 1 if wanted > gate else gate - 1
        s.on_at[x] = t + r.dead


@compiled
def _turn_on(r: Any, s: Any, x: int, t: float) -> None:
    """End a dead time of leg x."""
    wanted = 2 * s.level[x]
    up = 1 if wanted > s.gate[x] else -1
    s.gate[x] += up
    s.on_at[x] = math.inf
    if s.gate[x] != wanted:
        s.gate[x] += up
        s.on_at[x] = t + r.dead


@inlined
def _voltage(r: Any, s: Any, x: int, side: int, v_dc: float, mid: float, i: float) -> float:
    """Return the voltage of leg x above the lower rail, p.u. of v_dc, with the current i, p.u.,
    along its axis; ``side`` is 0 where it flows outwards."""
    b = r.band[s.gate[x], side]
    return b[0] * v_dc + b[1] * mid + b[2] - b[3] * i / (1.5 * r.leg)


@inlined
def _seen_by(n: Any, c: int, x: int, z: complex) -> float:
    """Return the part of a space vector of circuit c along the axis of leg x."""
    return _along(x, z * field(n, "axis")[c].conjugate())


@compiled
def _settle(plant: PlantRecords, k: int, c: int) -> None:
    """Find which devices of bridge k conduct, after its gates have changed or a current has become
    zero."""
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    none, which = 0, -1
    s.flows[0] = s.flows[1] = s.flows[2] = 0
    for x in range(3):
        if r.wide[s.gate[x]]:
            i = field(now, "w")[own(k) + I_F] * r.current
            along = _seen_by(n, c, x, i)
            if abs(along) > _NONE:
                s.flows[x] = 1 if along > 0.0 else -1
            else:
                none, which = none + 1, x
    s.open = -1
    if none >= 2:
        field(now, "w")[own(k) + I_F] = 0j
        v = field(now, "w")[own(k) + V]
        excess, out, into = _drives(n, c, r, s, v, s.x[V_DC], s.mid)
        if excess > 0.0:
            _conduct_pair(plant, k, c, out, into)
        else:
            s.open = 3
    elif none == 1:
        _hold_or_conduct(plant, k, c, which)
    _prepare(plant, k, c)


@compiled
def _drives(
    n: Any, c: int, r: Any, s: Any, v: complex, v_dc: float, mid: float
) -> tuple[float, int, int]:
    """Return by how much the circuit would drive a current through a bridge without any, p.u. of
    v_dc, and the legs by which it would leave and enter it."""
    out = into = 0
    low, high = -math.inf, math.inf
    for x in range(3):
        outside = _seen_by(n, c, x, v) / (1.5 * r.leg)
        least = _voltage(r, s, x, 0, v_dc, mid, 0.0) - outside
        most = _voltage(r, s, x, 1, v_dc, mid, 0.0) - outside
        if least > low:
            low, out = least, x
        if most < high:
            high, into = most, x
    return low - high, out, into


@compiled
def _conduct_pair(plant: PlantRecords, k: int, c: int, out: int, into: int) -> None:
    """Have two legs conduct, and the third one if the circuit then drives it."""
    r, s = plant.par[k], plant.st[k]
    s.open = -1
    s.flows[out] = 1 if r.wide[s.gate[out]] else 0
    s.flows[into] = -1 if r.wide[s.gate[into]] else 0
    third = 3 - out - into
    if r.wide[s.gate[third]]:
        _hold_or_conduct(plant, k, c, third)


@compiled
def _floats(
    n: Any, c: int, r: Any, s: Any, x: int, v: complex, i: complex, v_dc: float, mid: float
) -> float:
    """Return the voltage of leg x without current, whose two others conduct, p.u. of v_dc."""
    mean = 0.0
    for y in range(3):
        if y != x:
            side = 1 if s.flows[y] < 0 else 0
            mean += 0.5 * _voltage(r, s, y, side, v_dc, mid, _seen_by(n, c, y, i))
    return mean + 1.5 * _seen_by(n, c, x, v) / (1.5 * r.leg)


@compiled
def _hold_or_conduct(plant: PlantRecords, k: int, c: int, x: int) -> None:
    """Have leg x, which has no current, carry none, unless the circuit drives one."""
    n, r, s, w = plant.net[0], plant.par[k], plant.st[k], field(plant.now[0], "w")
    i = w[own(k) + I_F] * r.current
    has = _floats(n, c, r, s, x, w[own(k) + V], i, s.x[V_DC], s.mid)
    s.flows[x], s.open = 0, -1
    if has < _voltage(r, s, x, 0, s.x[V_DC], s.mid, 0.0):
        s.flows[x] = 1
    elif has > _voltage(r, s, x, 1, s.x[V_DC], s.mid, 0.0):
        s.flows[x] = -1
    else:
        s.open = x
        w[own(k) + I_F] -= _A[x] * field(n, "axis")[c] * (_seen_by(n, c, x, i) / r.current)


@compiled
def _prepare(plant: PlantRecords, k: int, c: int) -> None:
    """Set what bridge k's voltage is made of, and what drives the current of L_f, until the next
    edge. A leg without current takes its axis out of what drives."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    axis = field(n, "axis")[c]
    by_dc = by_mid = drop = 0j
    R_aa = R_bb = r.R_f
    R_ab = 0.0
    for x in range(3):
        b = r.band[s.gate[x], 1 if s.flows[x] < 0 else 0]
        a = _A[x] * axis
        if b[0] != 0.0:
            by_dc += b[0] * a
        if b[1] != 0.0:
            by_mid += b[1] * a
        if b[2] != 0.0:
            drop += b[2] * a
        if b[3] != 0.0:
            R = 2.0 / 3.0 * b[3]
            R_aa += R * a.real * a.real
            R_ab += R * a.real * a.imag
            R_bb += R * a.imag * a.imag
    s.by_dc, s.by_mid, drop = by_dc * r.leg, by_mid * r.leg, drop * r.leg
    per_L = r.omega_b / (r.L_f * r.current)
    q_aa = q_bb = per_L
    q_ab = 0.0
    if s.open == 3:
        q_aa = q_bb = 0.0
    elif s.open >= 0:
        a = _A[s.open] * axis
        q_aa, q_ab, q_bb = (
            per_L * a.imag * a.imag, -per_L * a.real * a.imag, per_L * a.real * a.real
        )  # fmt: skip
    s.di_dc = _times(q_aa, q_ab, q_bb, s.by_dc)
    s.di_mid = _times(q_aa, q_ab, q_bb, s.by_mid)
    s.di = _times(q_aa, q_ab, q_bb, drop)
    s.di_v[0], s.di_v[1], s.di_v[2] = q_aa, q_ab, q_bb
    scale = r.current
    s.di_i[0] = scale * (q_aa * R_aa + q_ab * R_ab)
    s.di_i[1] = scale * (q_aa * R_ab + q_ab * R_bb)
    s.di_i[2] = scale * (q_ab * R_aa + q_bb * R_ab)
    s.di_i[3] = scale * (q_ab * R_ab + q_bb * R_bb)


@inlined
def _times(q_aa: float, q_ab: float, q_bb: float, z: complex) -> complex:
    return complex(q_aa * z.real + q_ab * z.imag, q_ab * z.real + q_bb * z.imag)


@compiled
def _first_event(plant: PlantRecords, c: int, terms: int) -> tuple[float, int, int]:
    """Return when in the interval, as a part of it, the first of what is watched happens; in which
    converter; and what."""
    first, which, what = 1.0, -1, _NOTHING
    for k in range(plant.net[0].n_converters):
        if not _may_happen(plant, k, c, terms):
            continue
        a, f_a = 0.0, _strain(plant, k, c, terms, 0.0)[0]
        for part in range(1, 5):  # a current may leave zero and come back
            b = 0.25 * part * first
            f_b, found = _strain(plant, k, c, terms, b)
            if f_b > 0.0:
                first, what = _find(plant, k, c, terms, a, f_a, b, f_b, found)
                which = k
                break
            a, f_a = b, f_b
    return first, which, what


@compiled
def _may_happen(plant: PlantRecords, k: int, c: int, terms: int) -> bool:
    """Return whether anything that is watched of converter k may happen in the interval: not where
    it is currents alone, and each further from zero than all terms together can take it."""
    n, now, s = plant.net[0], plant.now[0], plant.st[k]
    if s.open >= 0 or s.i_most[0] < math.inf:
        return True
    x, i = field(now, "terms"), own(k) + I_F
    reach = _NONE
    for j in range(1, terms + 1):
        reach += abs(x[j, i].real) + abs(x[j, i].imag)
    for leg in range(3):
        if s.flows[leg] != 0 and s.flows[leg] * _seen_by(n, c, leg, x[0, i]) <= reach:
            return True
    return False


@compiled
def _find(
    plant: PlantRecords, k: int, c: int, terms: int,
    a: float, f_a: float, b: float, f_b: float, what: int,
) -> tuple[float, int]:  # fmt: skip
    """Return where the strain is zero, between a, where it is not above, and b, where it is; and
    what it is of. By false position (the Illinois form)."""
    side = 0
    for _ in range(_TRIES):
        at = 0.5 * (a + b)
        if f_a < -_CLOSE:  # else it may be that of a current which has just begun to flow
            at = (a * f_b - b * f_a) / (f_b - f_a)
        if not a < at < b or f_b < _CLOSE:
            break
        f, found = _strain(plant, k, c, terms, at)
        if f > 0.0:
            b, f_b, what = at, f, found
            f_a *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            a, f_a = at, f
            f_b *= 0.5 if side == -1 else 1.0
            side = -1
    return b, what


@compiled
def _strain(plant: PlantRecords, k: int, c: int, terms: int, tau: float) -> tuple[float, int]:
    """Return the largest of what is watched of converter k at a part tau of the interval, each
    above zero where it has happened, and which it is."""
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    worst, what = -math.inf, _NOTHING
    v_dc = dc_at(now, k, DC, terms, tau)
    if s.open >= 0 or _flows(s):
        i = w_at(now, own(k) + I_F, terms, tau) * r.current
        for x in range(3):
            if s.flows[x] != 0:
                value = -s.flows[x] * _seen_by(n, c, x, i)
                if value > worst:
                    worst, what = value, _ZERO + x
        if s.open >= 0:
            v, mid = w_at(now, own(k) + V, terms, tau), dc_at(now, k, MID, terms, tau)
            if s.open == 3:
                value, out, into = _drives(n, c, r, s, v, v_dc, mid)
                if value > worst:
                    worst, what = value, _PAIR + 3 * out + into
            else:
                x = s.open
                has = _floats(n, c, r, s, x, v, i, v_dc, mid)
                value = _voltage(r, s, x, 0, v_dc, mid, 0.0) - has
                if value > worst:
                    worst, what = value, _OUT + x
                value = has - _voltage(r, s, x, 1, v_dc, mid, 0.0)
                if value > worst:
                    worst, what = value, _IN + x
    if s.trip == 0 and s.i_most[0] < math.inf:
        asked = r.i_u_gain * s.u_now[0] + r.k_p * (1.0 - v_dc) + dc_at(now, k, REG, terms, tau)
        if s.limit == 0.0:
            value = max(asked - s.i_most[0], s.i_most[1] - asked)
        else:
            wound = s.limit * (1.0 - v_dc)
            value = max(s.limit * (limit_of(s) - asked), wound if s.winds > 0.0 else -wound)
        if value > worst:
            worst, what = value, _LIMIT
    return worst, what


@compiled
def _change(plant: PlantRecords, k: int, c: int, what: int) -> None:
    """Go on after an event in converter k, in the state at its instant."""
    r, s = plant.par[k], plant.st[k]
    if what == _LIMIT:
        _watch_source(r, s)
    elif what >= _PAIR:
        _conduct_pair(plant, k, c, (what - _PAIR) // 3, (what - _PAIR) % 3)
        _prepare(plant, k, c)
    elif what >= _OUT:
        x = (what - _OUT) % 3
        s.open, s.flows[x] = -1, 1 if what < _IN else -1
        _prepare(plant, k, c)
    else:
        w, axis = field(plant.now[0], "w"), field(plant.net[0], "axis")[c]
        i = w[own(k) + I_F]
        w[own(k) + I_F] = i - _A[what] * axis * _seen_by(plant.net[0], c, what, i)
        _settle(plant, k, c)


@inlined
def _see(r: Any, s: Any, which: int, v: complex, i_o: complex) -> None:
    """Keep what the sensors see at the beginning (0), the middle (1) or the end (2) of an
    interval."""
    s.seen[which, 0], s.seen[which, 1], s.seen[which, 2] = terminal(
        v.real, v.imag, i_o.real * r.current, i_o.imag * r.current
    )


@compiled
def _cut(plant: PlantRecords, terms: int, tau: float) -> None:
    """End an interval at a part tau of it."""
    n, now = plant.net[0], plant.now[0]
    w_to, dc_to = field(now, "w_to"), field(now, "dc_to")
    for which in range(2):
        at = tau if which else 0.5 * tau
        for i in range(n.n_states):
            w_to[which, i] = w_at(now, i, terms, at)
        for k in range(n.n_converters):
            for what in range(4):
                dc_to[which, k, what] = dc_at(now, k, what, terms, at)


@compiled
def _take(plant: PlantRecords, step: float) -> None:
    """Take the states on to the end of an interval of ``step`` s."""
    n, now = plant.net[0], plant.now[0]
    w, source, speed = field(now, "w"), field(now, "source"), field(now, "source_speed")
    w_to, dc_to = field(now, "w_to"), field(now, "dc_to")
    for k in range(n.n_converters):
        r, s, at = plant.par[k], plant.st[k], own(k)
        v_0, v_1, v_2 = s.x[V_DC], dc_to[0, k, DC], dc_to[1, k, DC]
        s.x[V_DC], s.i_reg = v_2, dc_to[1, k, REG]
        s.i_source, s.mid = dc_to[1, k, SOURCE], dc_to[1, k, MID]
        if r.energy > 0.0:
            s.drawn[0] = _drawn(r, s, w[at + I_F], v_0)
            s.drawn[1] = _drawn(r, s, w_to[0, at + I_F], v_1)
            s.drawn[2] = _drawn(r, s, w_to[1, at + I_F], v_2)
            discharge(r, s, step, v_0, v_1, v_2)
        if r.filtered:
            _see(r, s, 1, w_to[0, at + V], w_to[0, at + I_O])
            _see(r, s, 2, w_to[1, at + V], w_to[1, at + I_O])
            b_0, b_1, b_2, b_3 = _weights(step * r.omega_s)
            s.sensed[0] = b_0 * s.sensed[0] + b_1 * v_0 + b_2 * v_1 + b_3 * v_2
            for j in range(3):
                s.sensed[1 + j] = (
                    b_0 * s.sensed[1 + j]
                    + b_1 * s.seen[0, j] + b_2 * s.seen[1, j] + b_3 * s.seen[2, j]
                )  # fmt: skip
                s.seen[0, j] = s.seen[2, j]
    for i in range(n.n_states):
        w[i] = w_to[1, i]
    for k in range(n.n_converters, now.n_s):
        source[k] = source[k] * turned(speed[k] * step)


@inlined
def _drawn(r: Any, s: Any, i: complex, v_dc: float) -> float:
    """Return the power that the bridge draws, p.u.; the midpoint takes no part in it on average."""
    return v_dc * r.current * (s.by_dc.real * i.real + s.by_dc.imag * i.imag)


@inlined
def _weights(x: float) -> tuple[float, float, float, float]:
    """Return the weights of a first-order low-pass after x time constants: of its state, and of a
    parabola through its input at the beginning, the middle and the end."""
    if x < 0.1:
        f_3 = 1 / 6 - x * (1 / 24 - x * (1 / 120 - x * (1 / 720 - x * (1 / 5040 - x * (
            1 / 40320 - x * (1 / 362880 - x * (1 / 3628800)))))))  # fmt: skip
        f_2 = 0.5 - x * f_3
        f_1 = 1.0 - x * f_2
        whole = 1.0 - x * f_1
    else:
        whole, f_1, f_2, f_3 = integrals(x)
    return (
        whole, x * (f_1 - 3.0 * f_2 + 4.0 * f_3), x * (4.0 * f_2 - 8.0 * f_3),
        x * (4.0 * f_3 - f_2),
    )  # fmt: skip
