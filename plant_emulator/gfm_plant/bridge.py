"""Switched bridges: modulator, gates with dead time, diodes, and the period from edge to edge.

A topology is a table: for each state of the gates of a leg the least and the largest voltage that
the leg can have, as factors of v_dc and of the midpoint's displacement, and less or more by what
its devices drop. A current out of the leg meets the least one, a current into it the largest one:
with the upper switch on both are the upper rail; in the dead time they are the lower rail, by a
diode, and the upper one. A leg without current has any voltage between them, and no current flows
until the circuit would drive it beyond: then a diode, or a switch, conducts.

Even states of the gates are levels, the odd one above each is the dead time to the next one.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_plant.beside import advance_link, begin_average
from gfm_plant.dc_link import discharge
from gfm_plant.layout import LARGEST, field
from gfm_plant.model import DELTA, terminal
from gfm_plant.period import limit_voltage, take_command
from gfm_plant.port import begin_port, end_port
from gfm_plant.powers import begin_powers
from gfm_plant.records import COMPARE, N_GATES, PlantRecords
from gfm_plant.series import (
    DC,
    MID,
    REG,
    SOURCE,
    accept,
    begin_series,
    bend,
    choose_powers,
    end_series,
    find_path,
    find_tangent,
    find_terms,
    hold_current,
    is_plain,
    limit_of,
    look,
    make_powers,
    normal,
    of_leg,
)
from gfm_plant.solution import circuit, grid_source
from gfm_plant.sparse import turned
from gfm_plant.strides import ask_for_strides, is_whole
from gfm_plant.walk import low_pass, walk, walks
from gfm_runtime.compiled import compiled, inlined

_AXES = np.array([1.0, complex(-0.5, math.sqrt(0.75)), complex(-0.5, -math.sqrt(0.75))])
_NO_CURRENT = 1e-12  # p.u.; a smaller one is none
_INSTANT = 1e-15  # s; edges that are no further apart are one
_MOST_EVENTS = 200  # in a unit of the carrier; then currents may pass zero unseen
_MOST_STEPS = 100  # of a search
_BALANCE = 10.0  # of v_dc that legs are moved by, per p.u. of the midpoint's displacement
_RESOLUTION = 1e-14  # p.u.; what is watched has happened where it is further above zero
_NEAR = 1e-8  # part of an interval; Newton's next step is none


class Topology(NamedTuple):
    """What a leg can do."""

    levels: int  # how many voltages it has
    off: int  # the state of its gates that blocks it
    # for each state of the gates how a current leaves the leg, and how one enters it: by the rail N
    # or P or the midpoint O of the DC link, and by a switch, a diode, or both
    conducts: tuple[tuple[str, str], ...]


_LOW, _HIGH = ("N diode", "N switch"), ("P switch", "P diode")
TOPOLOGIES = {
    "two-level": Topology(2, 1, (_LOW, ("N diode", "P diode"), _HIGH)),
    "t-type": Topology(
        3,
        5,
        (
            _LOW, ("N diode", "O both"), ("O both", "O both"), ("O both", "P diode"), _HIGH,
            ("N diode", "P diode"),
        ),
    ),
}  # fmt: skip

# what ends an interval before its time: + the leg, its current is zero; it begins to conduct
# outwards, or inwards; + 3 * outwards + inwards, two legs begin to; + the leg, its current is at
# its limit, + 3 inwards; the DC source is at its limit, or leaves it
_NOTHING, _OUT, _IN, _PAIR, _PEAK, _LIMIT, _EVENTS = -1, 3, 6, 9, 18, 24, 26
_ALL = 3  # legs without current


def bands(kind: str, drops: tuple[float, float, float, float]) -> NDArray[np.float64]:
    """Return the table of a topology, (N_GATES, 2, 4); see ``band`` in `gfm_plant.records`.

    Args:
        kind: a key of ``TOPOLOGIES``.
        drops: thresholds of switch and diode, p.u. of v_dc, and their resistances, p.u.
    """
    V_s, V_d, R_s, R_d = drops
    rails = {"N": (0.0, 0.0), "O": (0.5, -0.5), "P": (1.0, 0.0)}
    devices = {"switch": (V_s, R_s), "diode": (V_d, R_d), "both": (V_s + V_d, R_s + R_d)}
    found = np.zeros((N_GATES, 2, 4))
    for gate, ways in enumerate(TOPOLOGIES[kind].conducts):
        for side, way in enumerate(ways):
            rail, device = way.split()
            V, R = devices[device]
            # outwards a threshold lowers the leg's voltage
            found[gate, side] = *rails[rail], V if side else -V, R
    return found


@inlined
def modulate(r: Any, s: Any, E: complex, v_dc: float, i: complex = 0j) -> tuple[int, int, int]:
    """Return the compare counts of three legs that give the voltage E, a space vector in p.u. that
    stands still, on average: what ideal firmware does.

    They are those of space-vector modulation: the largest and the smallest of the three voltages
    lie evenly around the middle of v_dc. What v_dc cannot give is cut off in each leg, which ends
    in six steps. With a midpoint all three are moved together, within what is left, so that the
    current i takes the midpoint back to the middle.
    """
    per_leg = 1.0 / (1.5 * r.leg * v_dc)
    a, b, c = _along(0, E) * per_leg, _along(1, E) * per_leg, _along(2, E) * per_leg
    low, high = min(a, b, c), max(a, b, c)
    middle = 0.5 - 0.5 * (high + low)
    if r.levels > 2:
        # what moving them upwards does to the current out of the midpoint
        upwards = 0.0
        for x in range(3):
            share = (a if x == 0 else (b if x == 1 else c)) + middle
            upwards += -_along(x, i) if share > 0.5 else _along(x, i)
        most = max(0.5 - 0.5 * (high - low), 0.0)
        move = _BALANCE * s.ends[0, MID] * (-1.0 if upwards > 0.0 else 1.0)
        middle += min(max(move, -most), most)
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
    return _AXES[x].real * z.real + _AXES[x].imag * z.imag


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
                    if plant.par[k].levels == 0:
                        begin_average(plant, k, c, unit)
                    else:
                        _load(plant, k, c, unit)
            a, b = max(begin, first) - first, min(end, last) - first
            whole, t = a == 0.0 and b == last - first, a
            while t < b:
                if walks(plant, c):
                    t = walk(plant, c, t, b)
                if t < b:
                    t = _advance_unit(plant, c, t, b, whole)
            for k in range(n.n_converters):
                s = plant.st[k]
                half = turned(0.5 * n.omega_b * s.u_now[1] * (b - a))
                s.ahead = normal(s.ahead * half * half)
                s.x[DELTA] += (b - a) * (n.omega_b * s.u_now[1] - speed)
            if last <= end:
                for k in range(n.n_converters):
                    s = plant.st[k]
                    for x in range(3):
                        s.on_at[x] -= n.unit_s
    end_series(plant, c, begin, end - begin)


@inlined
def _load(plant: PlantRecords, k: int, c: int, unit: int) -> None:
    """Begin a unit of the carrier: take the command that acts, and load compare values."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    s.ends[0, REG] -= r.i_u_gain * s.u_now[0]
    take_command(plant, k, field(n, "unit_part")[unit])
    s.ends[0, REG] += r.i_u_gain * s.u_now[0]
    _watch_source(r, s)
    if s.trip != 0 or _over_peak(n, c, r, s, 0) > 0.0:
        _block(r, s)
        s.E[0] = s.E[1] = 0.0
        return
    limit_voltage(s, r.m_max * s.ends[0, DC])
    if s.u_now[COMPARE] < 0.0:  # the controller gives none
        half = turned(0.5 * n.omega_b * s.u_now[1] * n.unit_s)
        E = complex(s.E[0], s.E[1]) * s.ahead * half
        i = complex(s.ends[0, 0], s.ends[0, 1]) * field(n, "axis")[c].conjugate()
        counts = modulate(r, s, E, s.ends[0, DC], i)
    else:
        counts = _taken(r, s, 0), _taken(r, s, 1), _taken(r, s, 2)
    down = n.updates == 2 and unit % 2 == 1  # the second half of the carrier's period
    for x in range(3):
        base = 0 if r.levels == 2 else min(counts[x] // r.counts, r.levels - 2)
        on = counts[x] - base * r.counts
        s.base[x] = base
        s.edges[x, 0] = -1.0 if down else on * r.count_s
        s.edges[x, 1] = math.inf if n.updates == 2 else (2 * r.counts - on) * r.count_s
        if down:
            s.edges[x, 1] = (r.counts - on) * r.count_s
        if on == r.counts:  # it stays above
            s.edges[x, 0] = math.inf


@inlined
def _block(r: Any, s: Any) -> None:
    """Turn all switches off until compare values are loaded."""
    s.soonest = math.inf
    for x in range(3):
        s.gate[x], s.level[x], s.base[x] = r.off, -1, -1
        s.edges[x, 0] = s.edges[x, 1] = s.on_at[x] = s.next[x] = math.inf


@inlined
def _over_peak(n: Any, c: int, r: Any, s: Any, end: int) -> float:
    """Return by how much a phase current is above the hardware's limit, p.u., at an end of an
    interval."""
    most = 0.0
    for x in range(3):
        most = max(most, abs(of_leg(n, c, x, s.ends[end, 0], s.ends[end, 1])))
    return r.current * most - r.i_peak


@inlined
def _watch_source(r: Any, s: Any) -> None:
    """Set between which limits the DC source's control is, and whether its integral goes on."""
    if s.trip != 0:
        s.limit, s.winds = 1.0, 0.0
        return
    asked = r.k_p * (1.0 - s.ends[0, DC]) + s.ends[0, REG]
    s.limit = 1.0 if asked > s.i_most[0] else (-1.0 if asked < s.i_most[1] else 0.0)
    s.winds = 0.0 if s.limit * (1.0 - s.ends[0, DC]) > 0.0 else 1.0


@compiled
def _advance_unit(plant: PlantRecords, c: int, begin: float, end: float, whole: bool) -> float:
    """Go on from edge to edge, between two instants of a unit, s after its beginning; ``whole``:
    it is all of it. Returns how far: to its end, or until `walk` may go on."""
    n, t, events = plant.net[0], begin, 0
    behind = whole and begin_port(plant)
    longest = LARGEST / field(n, "fastest")[c]
    for k in range(n.n_converters):
        s = plant.st[k]
        s.soonest = s.next[0] = s.next[1] = s.next[2] = begin
    while t < end:
        last = until = min(end, t + longest)
        watched = limited = False
        for k in range(n.n_converters):
            r, s = plant.par[k], plant.st[k]
            if r.levels == 0:
                continue
            if s.soonest <= t + _INSTANT:
                _switch(r, s, t)
            if s.due == 2:
                _settle(plant, k, c)
            if s.due > 0:
                _prepare(plant, k, c)
            until = min(until, s.soonest)
            limited = limited or _limited(r, s)
            watched = watched or limited or s.open >= 0 or _flows(s)
        alone, only = field(n, "alone")[c], n.switched if behind else 0
        if alone:
            begin_powers(plant.now[0], plant.st[0].slot)
        passes = plant.st[only].open < 0 if alone else behind and is_plain(plant, only)
        # a limit might be reached before edges that are passed already
        if passes and plant.par[only].dead > 0.0 and not limited:
            until = _pass_edges(plant, only, c, t, last)
        h, tau, which, what = until - t, 1.0, -1, _NOTHING
        terms = find_terms(plant, c, h, t)
        if watched and events < _MOST_EVENTS:
            tau, which, what = _first_event(plant, c, h, terms)
        for k in range(n.n_converters):
            if behind and plant.par[k].levels == 0:
                continue
            if t == begin and plant.par[k].filtered:
                _see(plant.par[k], plant.st[k], 0)
            if tau < 1.0 and k != which:
                look(plant, k, c, h, terms, tau)
            _sense(plant, k, c, h, terms, tau)
        accept(plant, c, h, t, terms, tau)
        t = until if tau == 1.0 else t + tau * h
        if what != _NOTHING:
            events += 1
            _change(plant, which, c, what)
        elif alone and walks(plant, c) and is_whole(plant, t):
            break
    if behind:
        end_port(plant)
    return t


@inlined
def _switch(r: Any, s: Any, t: float) -> None:
    """Turn on and off what the edges and dead times of a bridge ask for at an instant of a unit."""
    s.soonest, s.due = math.inf, 2
    for x in range(3):
        if s.next[x] <= t + _INSTANT:
            s.level[x], s.gate[x], s.on_at[x] = _switched(r, s, x, t)
            e_0, e_1 = s.edges[x, 0], s.edges[x, 1]
            s.next[x] = min(e_0 if t < e_0 else (e_1 if t < e_1 else math.inf), s.on_at[x])
        s.soonest = min(s.soonest, s.next[x])


@inlined
def _switched(r: Any, s: Any, x: int, t: float) -> tuple[int, int, float]:
    """Return the level and the gates of leg x after an instant of a unit, and when its dead time
    ends."""
    level, gate, on_at = s.level[x], s.gate[x], s.on_at[x]
    to = s.base[x] + (1 if t < s.edges[x, 0] or t >= s.edges[x, 1] else 0)
    if to != level and s.base[x] >= 0:  # what is on turns off at once
        level = to
        if r.dead == 0.0 or (gate == r.off and gate % 2 == 1 and r.levels > 2):
            gate, on_at = 2 * level, math.inf
        elif gate % 2 == 1:
            on_at = t + r.dead
        elif gate != 2 * level:
            gate, on_at = gate + (1 if 2 * level > gate else -1), t + r.dead
    while on_at <= t + _INSTANT:
        up = 1 if 2 * level > gate else -1
        gate, on_at = gate + up, math.inf
        if gate != 2 * level:
            gate, on_at = gate + up, t + r.dead
    return level, gate, on_at


@compiled
def _pass_edges(plant: PlantRecords, k: int, c: int, t: float, last: float) -> float:
    """Let the gates of the only bridge change as long as its equations stay the same, since each
    current that decides keeps its sign; returns when they do not, at the latest ``last``."""
    r, s, path = plant.par[k], plant.st[k], find_tangent(plant, k, c)
    while s.soonest < last and _stay(plant.net[0], r, s, path, c, t):
        _switch(r, s, s.soonest)
        for x in range(3):
            if not r.wide[s.gate[x]]:
                s.flows[x] = 0
    return min(s.soonest, last)


@inlined
def _stay(n: Any, r: Any, s: Any, path: Any, c: int, t: float) -> bool:
    """Return whether the equations stay the same at the next change of the gates of the only
    bridge, in an interval from t on in which its current has this path."""
    at = s.soonest
    i_a, i_b, di_a, di_b, bends = path
    unsure = (at + r.dead - t) ** 2 * bends
    for y in range(3):
        changes = s.next[y] <= at + _INSTANT
        if changes or s.flows[y] != 0:
            i, slope = of_leg(n, c, y, i_a, i_b), of_leg(n, c, y, di_a, di_b)
            begin = i if s.flows[y] != 0 else i + slope * (at - t)
            end = i + slope * (at - t + (r.dead if changes else 0.0))
            if not (min(begin, end) > unsure or max(begin, end) < -unsure):
                return False
            if changes:
                side, gate = 1 if end < 0.0 else 0, _switched(r, s, y, at)[1]
                if r.band_kind[gate, side] != r.band_kind[s.gate[y], side]:
                    return False
    return True


@inlined
def _limited(r: Any, s: Any) -> bool:
    """Return whether the limits of phase currents or of the DC source may end an interval."""
    return r.i_peak < math.inf or s.i_most[0] < math.inf


@inlined
def _flows(s: Any) -> bool:
    """Return whether the sign of a current decides on the voltage of its leg."""
    return s.flows[0] != 0 or s.flows[1] != 0 or s.flows[2] != 0


@inlined
def _voltage(r: Any, s: Any, x: int, side: int, end: int, i: float) -> float:
    """Return the voltage of leg x above the lower rail, p.u. of v_dc, with the current i, p.u.,
    along its axis; ``side`` is 0 where it flows outwards, ``end`` a row of ``ends``."""
    b = r.band[s.gate[x], side]
    constant = b[2] if end < 2 else 0.0
    return b[0] * s.ends[end, DC] + b[1] * s.ends[end, MID] + constant - b[3] * i / (1.5 * r.leg)


@inlined
def _settle(plant: PlantRecords, k: int, c: int) -> None:
    """Find which devices of bridge k conduct, after its gates have changed or a current has become
    zero."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    none, which = 0, -1
    s.flows[0] = s.flows[1] = s.flows[2] = 0
    for x in range(3):
        if r.wide[s.gate[x]]:
            along = r.current * of_leg(n, c, x, s.ends[0, 0], s.ends[0, 1])
            if abs(along) > _NO_CURRENT:
                s.flows[x] = 1 if along > 0.0 else -1
            else:
                none, which = none + 1, x
    s.open = -1
    if none >= 2:
        hold_current(plant, k, c, 0j)
        excess, out, into = _drives(n, c, r, s)
        if excess > 0.0:
            _conduct_pair(plant, k, c, out, into)
        else:
            s.open = _ALL
    elif none == 1:
        _hold_or_conduct(plant, k, c, which)


@compiled
def _drives(n: Any, c: int, r: Any, s: Any) -> tuple[float, int, int]:
    """Return by how much the circuit would drive a current through a bridge without any, p.u. of
    v_dc, and the legs by which it would leave and enter it."""
    out = into = 0
    low, high = -math.inf, math.inf
    for x in range(3):
        least, most = _against(n, c, r, s, x, 0, 0), _against(n, c, r, s, x, 1, 0)
        if least > low:
            low, out = least, x
        if most < high:
            high, into = most, x
    return low - high, out, into


@inlined
def _against(n: Any, c: int, r: Any, s: Any, x: int, side: int, end: int) -> float:
    """Return by how much the voltage by which a current leaves, or enters, leg x is above the
    circuit's."""
    outside = of_leg(n, c, x, s.ends[end, 2], s.ends[end, 3]) / (1.5 * r.leg)
    return _voltage(r, s, x, side, end, 0.0) - outside


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
def _beyond(n: Any, c: int, r: Any, s: Any, x: int, end: int) -> tuple[float, float]:
    """Return by how much the voltage of leg x, which has no current and whose two others conduct,
    is below the least and above the largest one that it can have, p.u. of v_dc."""
    mean = 0.0
    for y in range(3):
        if y != x:
            side = 1 if s.flows[y] < 0 else 0
            i = r.current * of_leg(n, c, y, s.ends[end, 0], s.ends[end, 1])
            mean += 0.5 * _voltage(r, s, y, side, end, i)
    has = mean + of_leg(n, c, x, s.ends[end, 2], s.ends[end, 3]) / r.leg
    return _voltage(r, s, x, 0, end, 0.0) - has, has - _voltage(r, s, x, 1, end, 0.0)


@compiled
def _hold_or_conduct(plant: PlantRecords, k: int, c: int, x: int) -> None:
    """Have leg x, which has no current, carry none, unless the circuit drives one."""
    s = plant.st[k]
    out, into = _beyond(plant.net[0], c, plant.par[k], s, x, 0)
    s.flows[x], s.open = 0, -1
    if out > 0.0:
        s.flows[x] = 1
    elif into > 0.0:
        s.flows[x] = -1
    else:
        s.open = x
        _end_current(plant, k, c, x)


@compiled
def _end_current(plant: PlantRecords, k: int, c: int, x: int) -> None:
    """Take what rounding has left of leg x's current."""
    n, s = plant.net[0], plant.st[k]
    a, b, axis = s.ends[0, 0], s.ends[0, 1], field(n, "leg_axis")[c, x]
    along = of_leg(n, c, x, a, b)
    hold_current(plant, k, c, complex(a - along * axis.real, b - along * axis.imag))


@inlined
def _prepare(plant: PlantRecords, k: int, c: int) -> None:
    """Make the equations ready until the next edge."""
    plant.st[k].due = 0
    if not field(plant.net[0], "alone")[c]:
        _set_rates(plant, k, c)
    else:
        if choose_powers(plant, c, _key(plant.net[0], plant.par[0], plant.st[0], c)):
            _set_rates(plant, 0, c)
            make_powers(plant, c)
        if is_plain(plant, 0):
            ask_for_strides(plant, c)


@inlined
def _key(n: Any, r: Any, s: Any, c: int) -> int:
    """Return a number > 0 of what the equations of a bridge depend on, besides its parameters."""
    a = r.band_kind[s.gate[0], 1 if s.flows[0] < 0 else 0]
    b = r.band_kind[s.gate[1], 1 if s.flows[1] < 0 else 0]
    d = r.band_kind[s.gate[2], 1 if s.flows[2] < 0 else 0]
    if r.cancels and a == b and b == d:
        a = b = d = 0
    key = ((a * 16 + b) * 16 + d) * 8 + s.open + 1
    key = key * 3 + int(s.limit) + 1
    key = (key * 2 + (1 if s.winds > 0.0 else 0)) * 2 + (1 if s.chopper > 0.0 else 0)
    return key * len(field(n, "alone")) + c + 1


@compiled
def _set_rates(plant: PlantRecords, k: int, c: int) -> None:
    """Set what bridge k's voltage is made of, and what drives the current of L_f, until the next
    edge. A leg without current takes its axis out of what drives."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    by_dc = by_mid = drop = 0j
    R_aa = R_bb = r.R_f
    R_ab = 0.0
    for x in range(3):
        b = r.band[s.gate[x], 1 if s.flows[x] < 0 else 0]
        a = field(n, "leg_axis")[c, x]
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
    if s.open == _ALL:
        q_aa = q_bb = 0.0
    elif s.open >= 0:
        a = field(n, "leg_axis")[c, s.open]
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


@inlined
def _first_event(plant: PlantRecords, c: int, h: float, terms: int) -> tuple[float, int, int]:
    """Return when in the interval, as a part of it, the first of what is watched happens; in which
    converter; and what. ``ends`` of that converter lead there then."""
    n, first, slope, which, what = plant.net[0], 1.0, 0.0, -1, _NOTHING
    for k in range(n.n_converters):
        r, s = plant.par[k], plant.st[k]
        known, most = False, _OUT
        if r.levels == 0:
            continue
        if _limited(r, s):
            most = _EVENTS
        elif s.open >= 0:
            most = _PEAK if s.open == _ALL else _PAIR
        for one in range(most):
            if not _watches(r, s, one):
                continue
            highest = max(_excess(n, c, r, s, one, 0), _excess(n, c, r, s, one, 1))
            if one < _OUT and highest < -r.current * bend(plant, k, c, h):
                continue  # paths of currents are nearly straight
            if not known:
                find_path(plant, k, c, h, terms)
                known = True
            at, steep = _crossing(n, c, r, s, one, first)
            if at < first:
                first, slope, which, what = at, steep, k, one
    if what != _NOTHING:
        first = _search(plant, which, c, h, terms, what, first, slope)
        if math.isnan(first):
            return 1.0, -1, _NOTHING
    return first, which, what


@inlined
def _watches(r: Any, s: Any, what: int) -> bool:
    """Return whether an event may end the interval of a converter."""
    if what < _OUT:
        return s.flows[what] != 0
    if what < _PAIR:
        return s.open == what % 3
    if what < _PEAK:
        out, into = (what - _PAIR) // 3, (what - _PAIR) % 3
        return s.open == _ALL and out != into
    if what < _LIMIT:
        return r.i_peak < math.inf and s.base[0] >= 0
    return s.trip == 0 and s.i_most[0] < math.inf


@compiled
def _excess(n: Any, c: int, r: Any, s: Any, what: int, end: int) -> float:
    """Return what is above zero where an event has happened, at an end of the interval, or a term
    of its series: rows of ``ends``."""
    if what < _OUT:
        return -s.flows[what] * r.current * of_leg(n, c, what, s.ends[end, 0], s.ends[end, 1])
    if what < _PAIR:
        return _beyond(n, c, r, s, what % 3, end)[0 if what < _IN else 1]
    if what < _PEAK:
        out, into = (what - _PAIR) // 3, (what - _PAIR) % 3
        return _against(n, c, r, s, out, 0, end) - _against(n, c, r, s, into, 1, end)
    one = 1.0 if end < 2 else 0.0
    if what < _LIMIT:
        sign = 1.0 if what < _PEAK + 3 else -1.0
        i = of_leg(n, c, (what - _PEAK) % 3, s.ends[end, 0], s.ends[end, 1])
        return sign * r.current * i - one * r.i_peak
    below = one - s.ends[end, DC]
    asked = r.k_p * below + s.ends[end, REG]
    if s.limit == 0.0:
        return asked - one * s.i_most[0] if what == _LIMIT else one * s.i_most[1] - asked
    if what == _LIMIT:
        return s.limit * (one * limit_of(s) - asked)
    return s.limit * below * (1.0 if s.winds > 0.0 else -1.0)


@compiled
def _crossing(
    n: Any, c: int, r: Any, s: Any, what: int, most: float
) -> tuple[float, float]:  # fmt: skip
    """Return about when an event first happens, as a part of the interval up to ``most`` (inf: it
    does not), and how steep its excess is there.

    By its series up to tau^N_PATH, and a further term that leads to its end.
    """
    p_0, p_1, p_2, p_3, p_4 = (
        _excess(n, c, r, s, what, 0), _excess(n, c, r, s, what, 2), _excess(n, c, r, s, what, 3),
        _excess(n, c, r, s, what, 4), _excess(n, c, r, s, what, 5),
    )  # fmt: skip
    p_5 = _excess(n, c, r, s, what, 1) - (p_0 + p_1 + p_2 + p_3 + p_4)
    a, f_a = 0.0, p_0
    for part in range(1, 5):  # a current may leave zero and come back
        b = 0.25 * part * most
        f_b = p_0 + b * (p_1 + b * (p_2 + b * (p_3 + b * (p_4 + b * p_5))))
        if f_b > _RESOLUTION:
            break
        a, f_a = b, f_b
    if a == most:
        return math.inf, 0.0
    at, slope = 0.5 * (a + b), 0.0
    if f_a < -_RESOLUTION:  # else it may be that of a current which has just begun to flow
        at = (a * f_b - b * f_a) / (f_b - f_a)
    for _ in range(_MOST_STEPS):
        f = p_0 + at * (p_1 + at * (p_2 + at * (p_3 + at * (p_4 + at * p_5))))
        slope = p_1 + at * (2.0 * p_2 + at * (3.0 * p_3 + at * (4.0 * p_4 + at * 5.0 * p_5)))
        a, b = (a, at) if f > 0.0 else (at, b)
        to = _newton(a, b, at, f, slope)
        at, step = to, abs(to - at)
        if step < _NEAR:
            break
    return at, slope


@inlined
def _newton(a: float, b: float, at: float, f: float, slope: float) -> float:
    """Return where f is zero by its slope, or the middle if that is not between a and b."""
    to = at - f / slope
    return to if a < to < b else 0.5 * (a + b)


@compiled
def _search(
    plant: PlantRecords, k: int, c: int, h: float, terms: int, what: int, at: float, slope: float
) -> float:  # fmt: skip
    """Take ``ends`` to where an event happens, near a part of the interval; returns that part. NaN,
    and ``ends`` at its end: it only nearly does."""
    n, r, s = plant.net[0], plant.par[k], plant.st[k]
    a, b, f = 0.0, 1.0, 0.0
    for _ in range(_MOST_STEPS):
        look(plant, k, c, h, terms, at)
        f = _excess(n, c, r, s, what, 1)
        if abs(f) <= _RESOLUTION:
            break
        a, b = (a, at) if f > 0.0 else (at, b)
        to = _newton(a, b, at, f, slope)
        if to == at:
            break
        at = to
    if f < -_NO_CURRENT:
        look(plant, k, c, h, terms, 1.0)
        return math.nan
    return at


@compiled
def _change(plant: PlantRecords, k: int, c: int, what: int) -> None:
    """Go on after an event in converter k, in the state at its instant."""
    r, s = plant.par[k], plant.st[k]
    s.due = max(s.due, 1)
    if what >= _LIMIT:
        _watch_source(r, s)
    elif what >= _PEAK:
        _block(r, s)
        s.due = 2
    elif what >= _PAIR:
        _conduct_pair(plant, k, c, (what - _PAIR) // 3, (what - _PAIR) % 3)
    elif what >= _OUT:
        x = (what - _OUT) % 3
        s.open, s.flows[x] = -1, 1 if what < _IN else -1
    else:
        _end_current(plant, k, c, what)
        s.due = 2


@inlined
def _sense(plant: PlantRecords, k: int, c: int, h: float, terms: int, tau: float) -> None:
    """Take the battery and the sensors' filters on over a part tau of an interval of h s, and the
    DC link of an averaged bridge."""
    r, s = plant.par[k], plant.st[k]
    step, v_0, v_2 = tau * h, s.ends[0, DC], s.ends[1, DC]
    v_1 = 0.0
    if r.levels == 0:
        v_0, v_1, v_2 = advance_link(plant, k, h, terms, tau)
    elif r.energy > 0.0:
        s.drawn[0], s.drawn[2] = _drawn(r, s, 0), _drawn(r, s, 1)
        look(plant, k, c, h, terms, 0.5 * tau)
        s.drawn[1], v_1 = _drawn(r, s, 1), s.ends[1, DC]
        discharge(r, s, step, v_0, v_1, v_2)
        look(plant, k, c, h, terms, tau)
    if not r.filtered:
        return
    b_0, b_1, b_2, b_3 = low_pass(step * r.omega_s)
    if r.levels > 0:
        v_1 = 0.5 * (v_0 + v_2) + 0.125 * step * (_dc_slope(r, s, 0) - _dc_slope(r, s, 1))
    s.sensed[0] = b_0 * s.sensed[0] + b_1 * v_0 + b_2 * v_1 + b_3 * v_2
    _see(r, s, 1)
    for j in range(3):  # the value in the middle by those at the ends and their slopes
        middle = 0.5 * (s.seen[0, j] + s.seen[1, j])
        middle += 0.125 * step * (s.seen_slopes[0, j] - s.seen_slopes[1, j])
        s.sensed[1 + j] = (
            b_0 * s.sensed[1 + j] + b_1 * s.seen[0, j] + b_2 * middle + b_3 * s.seen[1, j]
        )
        s.seen[0, j], s.seen_slopes[0, j] = s.seen[1, j], s.seen_slopes[1, j]


@inlined
def _see(r: Any, s: Any, end: int) -> None:
    """Keep what the sensors see at an end of an interval, p, q and V, and what these change by in a
    second."""
    v_a, v_b = s.ends[end, 2], s.ends[end, 3]
    o_a, o_b = r.current * s.ends[end, 4], r.current * s.ends[end, 5]
    dv_a, dv_b = s.slopes[end, 0], s.slopes[end, 1]
    do_a, do_b = r.current * s.slopes[end, 2], r.current * s.slopes[end, 3]
    p, q, v = terminal(v_a, v_b, o_a, o_b)
    s.seen[end, 0], s.seen[end, 1], s.seen[end, 2] = p, q, v
    s.seen_slopes[end, 0] = dv_a * o_a + v_a * do_a + dv_b * o_b + v_b * do_b
    s.seen_slopes[end, 1] = dv_b * o_a + v_b * do_a - dv_a * o_b - v_a * do_b
    s.seen_slopes[end, 2] = (v_a * dv_a + v_b * dv_b) / v if v > 0.0 else 0.0


@inlined
def _dc_slope(r: Any, s: Any, end: int) -> float:
    """Return what v_dc changes by in a second at an end of an interval, Eq. (8)."""
    v_dc, gives = s.ends[end, DC], s.ends[end, SOURCE]
    if r.tau_dc == 0.0:
        gives = limit_of(s) if s.limit != 0.0 else r.k_p * (1.0 - v_dc) + s.ends[end, REG]
    drawn = r.current * (s.by_dc.real * s.ends[end, 0] + s.by_dc.imag * s.ends[end, 1])
    return r.omega_b / r.C_dc * (gives - s.chopper * v_dc - drawn)


@inlined
def _drawn(r: Any, s: Any, end: int) -> float:
    """Return the power that the bridge draws, p.u.; the midpoint takes no part in it on average."""
    i_a, i_b = s.ends[end, 0], s.ends[end, 1]
    return s.ends[end, DC] * r.current * (s.by_dc.real * i_a + s.by_dc.imag * i_b)
