"""One converter on its grid from edge to edge by `strides`, while nothing can happen but edges.

That is so for a bridge of two levels without drops and without limits that may end an interval, as
long as no current may become zero in a dead time. What the sensors make of the path comes at its
end, for all edges in one go, of several numbers at a time.
"""

import math
from typing import Any

import numpy as np

from gfm_plant.layout import EDGES, field
from gfm_plant.powers import P
from gfm_plant.records import PlantRecords
from gfm_plant.series import DC, REG, is_plain, of_leg, plain_tangent
from gfm_plant.solution import integrals
from gfm_plant.strides import serve, stride
from gfm_runtime.compiled import compiled, inlined

# direction of the bridge's voltage by which legs are at the upper rail: leg k counts 2^k
_ANGLES = np.exp(1j * np.pi / 3 * np.array([0, 0, 2, 1, 4, 5, 3, 0]))
_ANGLES[[0, 7]] = 0.0
_INSTANT = 1e-15  # s
_SHORT = 0.1  # time constants up to which the weights of a low-pass have a short series
_NO_PATH = 0.0, 0.0, 0.0, 0.0, 0.0
# rows of ``walked``, by edges: states and grid as in ``vector``; of the interval before an edge its
# length and the voltage by v_dc; and what these make of it: the values of v_dc, p, q and V, their
# slopes, that of v_dc after the edge, and weights of the low-pass
_H, _BY, _SEEN, _SLOPE, _AFTER, _WEIGHT = 11, 12, 14, 18, 22, 23


@inlined
def walks(plant: PlantRecords, c: int) -> bool:
    """Return whether `walk` may go on in circuit c."""
    r, s = plant.par[0], plant.st[0]
    return bool(
        field(plant.net[0], "alone")[c] and is_plain(plant, 0) and r.energy == 0.0 and s.trip == 0
        and s.base[0] >= 0 and r.i_peak == math.inf and s.i_most[0] == math.inf and serve(plant, c)
    )  # fmt: skip


@compiled
def walk(plant: PlantRecords, c: int, begin: float, end: float) -> float:
    """Go on between two instants of a unit, s after its beginning; returns how far."""
    n, r, s, now = plant.net[0], plant.par[0], plant.st[0], plant.now[0]
    x, to, t, points = field(now, "vector"), field(now, "walked"), begin, 0
    axis = field(n, "leg_axis")[c, 0]
    _keep(x, to, 0)
    while t < end and points < EDGES - 1:
        rails = _set_gates(n, c, r, s, t)
        by = _ANGLES[rails] * axis
        s.by_dc = complex(r.leg * by.real, r.leg * by.imag)
        until = _look_ahead(plant, c, t, end, rails)
        kind = 0 if rails == 0 or rails == 7 else 1
        if until < t or not stride(plant, kind, until - t, by.real, by.imag):
            break
        points += 1
        _keep(x, to, points)
        to[_H, points] = until - t
        to[_BY, points], to[_BY + 1, points] = s.by_dc.real, s.by_dc.imag
        for j in range(REG + 1):
            s.ends[0, j] = x[0, j]
        t = until
    if not t < end:  # what is to change at once is a matter of what follows
        _set_gates(n, c, r, s, t - _INSTANT)
    s.soonest = s.next[0] = s.next[1] = s.next[2] = t
    if r.filtered and points > 0:
        _sense(plant, c, points)
    return t


@inlined
def _set_gates(n: Any, c: int, r: Any, s: Any, t: float) -> int:
    """Turn on and off what the edges up to an instant and dead times ask for; returns which legs
    are at the upper rail, the first one's counts 1."""
    rails = 0
    for leg in range(3):
        e_0, e_1 = s.edges[leg, 0], s.edges[leg, 1]
        level = 1 if t < e_0 or t >= e_1 else 0
        if level != s.level[leg]:
            s.level[leg], s.gate[leg] = level, r.off
            s.on_at[leg] = r.dead + (e_1 if t >= e_1 else (max(e_0, 0.0) if t >= e_0 else 0.0))
        if s.on_at[leg] <= t:
            s.gate[leg], s.on_at[leg] = 2 * level, math.inf
        into = of_leg(n, c, leg, s.ends[0, 0], s.ends[0, 1]) < 0.0
        rails += 1 << leg if s.gate[leg] == 2 or (s.gate[leg] == r.off and into) else 0
    return rails


@inlined
def _look_ahead(plant: PlantRecords, c: int, t: float, end: float, rails: int) -> float:
    """Return until when the legs stay at their rails, -1: in a dead time a current may become zero.

    An edge is passed if its leg's current keeps its voltage until the dead time ends.
    """
    n, r, s, until = plant.net[0], plant.par[0], plant.st[0], end
    i_a, i_b, di_a, di_b, bends = plain_tangent(plant, 0, c) if r.dead > 0.0 else _NO_PATH
    for leg in range(3):
        e_0, e_1, on_at = s.edges[leg, 0], s.edges[leg, 1], s.on_at[leg]
        edge, stops = e_0 if t < e_0 else (e_1 if t < e_1 else math.inf), False
        if r.dead > 0.0:
            i, slope = of_leg(n, c, leg, i_a, i_b), of_leg(n, c, leg, di_a, di_b)
            if s.gate[leg] == r.off:
                then, unsure = i + slope * (on_at - t), (on_at - t) ** 2 * bends
                if not (min(i, then) > unsure or max(i, then) < -unsure):
                    return -1.0
                if (rails >> leg) & 1 != s.level[leg]:
                    until = min(until, on_at)
            stops = (s.gate[leg] == r.off and edge < on_at) or edge < e_1 <= edge + r.dead
            at, unsure = i + slope * (edge - t), (edge + r.dead - t) ** 2 * bends
            then = at + slope * r.dead
            if s.level[leg] == 0:
                stops = stops or not min(at, then) > unsure
            else:
                stops = stops or not max(at, then) < -unsure
            edge += 0.0 if stops else r.dead
        until = min(until, edge)
    return until


@inlined
def _keep(x: Any, to: Any, point: int) -> None:
    for j in range(P + 2):
        to[j, point] = x[0, j]


@inlined
def _sense(plant: PlantRecords, c: int, points: int) -> None:
    """Take the sensors' filters on along the path: parabolas from edge to edge, whose values in the
    middle follow from those at both ends and their slopes."""
    s, to = plant.st[0], field(plant.now[0], "walked")
    lanes = EDGES if points >= EDGES // 2 else EDGES // 2
    _see(plant, c, lanes)
    _weigh(plant.par[0].omega_s, points, lanes, to)
    for j in range(4):
        sensed = s.sensed[j]
        for k in range(1, points + 1):
            f_0, f_2 = to[_SEEN + j, k - 1], to[_SEEN + j, k]
            before = to[_AFTER, k - 1] if j == 0 else to[_SLOPE + j, k - 1]
            f_1 = 0.5 * (f_0 + f_2) + 0.125 * to[_H, k] * (before - to[_SLOPE + j, k])
            sensed = to[_WEIGHT, k] * sensed + (
                to[_WEIGHT + 1, k] * f_0 + to[_WEIGHT + 2, k] * f_1 + to[_WEIGHT + 3, k] * f_2
            )
        s.sensed[j] = sensed


@compiled
def _see(plant: PlantRecords, c: int, lanes: int) -> None:
    """Find what the sensors see at all edges, and what it changes by in a second."""
    n, r, s, to = plant.net[0], plant.par[0], plant.st[0], field(plant.now[0], "walked")
    q = field(n, "own_rates")[c, 0, 0]
    by_i, by_v, by_o, o_by_v, o_by_o, grid = (
        q[0], q[1], q[2], q[3], q[4], field(n, "link")[c, 1, 0, 0]
    )  # fmt: skip
    current, k_p, chopper, per_C = r.current, r.k_p, s.chopper, r.omega_b / r.C_dc
    for k in range(lanes):
        i_a, i_b, v_a, v_b = to[0, k], to[1, k], to[2, k], to[3, k]
        o_a, o_b, v_dc = to[4, k], to[5, k], to[DC, k]
        dv_a, dv_b = by_i * i_a + by_v * v_a + by_o * o_a, by_i * i_b + by_v * v_b + by_o * o_b
        do_a = current * (o_by_v * v_a + o_by_o * o_a + grid * to[P, k])
        do_b = current * (o_by_v * v_b + o_by_o * o_b + grid * to[P + 1, k])
        o_a, o_b, size = current * o_a, current * o_b, math.sqrt(v_a * v_a + v_b * v_b)
        gives = k_p * (1.0 - v_dc) + to[REG, k] - chopper * v_dc
        drawn = current * (to[_BY, k] * i_a + to[_BY + 1, k] * i_b)
        then = current * (to[_BY, k + 1] * i_a + to[_BY + 1, k + 1] * i_b)
        to[_SEEN, k], to[_SEEN + 1, k] = v_dc, v_a * o_a + v_b * o_b
        to[_SEEN + 2, k], to[_SEEN + 3, k] = v_b * o_a - v_a * o_b, size
        to[_SLOPE, k], to[_AFTER, k] = per_C * (gives - drawn), per_C * (gives - then)
        to[_SLOPE + 1, k] = dv_a * o_a + v_a * do_a + dv_b * o_b + v_b * do_b
        to[_SLOPE + 2, k] = dv_b * o_a + v_b * do_a - dv_a * o_b - v_a * do_b
        to[_SLOPE + 3, k] = (v_a * dv_a + v_b * dv_b) / size if size > 0.0 else 0.0


@inlined
def _weigh(omega: float, points: int, lanes: int, to: Any) -> None:
    """Find the weights of the low-pass in all intervals."""
    for k in range(lanes):
        to[_WEIGHT, k], to[_WEIGHT + 1, k], to[_WEIGHT + 2, k], to[_WEIGHT + 3, k] = _short(
            omega * to[_H, k]
        )
    for k in range(1, points + 1):
        x = omega * to[_H, k]
        if x >= _SHORT:
            b_0, b_1, b_2, b_3 = low_pass(x)
            to[_WEIGHT, k], to[_WEIGHT + 1, k] = b_0, b_1
            to[_WEIGHT + 2, k], to[_WEIGHT + 3, k] = b_2, b_3


@inlined
def low_pass(x: float) -> tuple[float, float, float, float]:
    """Return the weights of a first-order low-pass after x time constants: of its state, and of a
    parabola through its input at the beginning, the middle and the end."""
    if x < _SHORT:
        return _short(x)
    whole, f_1, f_2, f_3 = integrals(x)
    return _weights(x, whole, f_1, f_2, f_3)


@inlined
def _short(x: float) -> tuple[float, float, float, float]:
    y = x * x  # by powers of two, so that few products wait for each other
    f_3 = (1 / 6 - x * (1 / 24)) + y * ((1 / 120 - x * (1 / 720)) + y * (1 / 5040))
    f_2 = 0.5 - x * f_3
    return _weights(x, (1.0 - x) + y * f_2, (1.0 - 0.5 * x) + y * f_3, f_2, f_3)


@inlined
def _weights(
    x: float, whole: float, f_1: float, f_2: float, f_3: float
) -> tuple[float, float, float, float]:
    return (
        whole, x * (f_1 - 3.0 * f_2 + 4.0 * f_3), x * (4.0 * f_2 - 8.0 * f_3),
        x * (4.0 * f_3 - f_2),
    )  # fmt: skip
