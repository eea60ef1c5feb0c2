"""A network of averaged bridges as its only switched bridge sees it.

Between two edges only that bridge's voltage E jumps; all else is linear with constant coefficients,
w' = A w + B s + b E, for a whole unit of the carrier. Own are the states of the switched converter,
whose series goes from edge to edge (`series`); of the rest it needs only what drives its line's
current, g(t). By superposition g, and all states at the end of the unit, are sums of what
the states and sources at its beginning do, and of what E does,

    w(t) = ... + integral of e^(A (t - tau)) b E(tau) d tau,

and with powers of t and tau about the middle of the unit this needs no more than the moments of E.
So a unit costs the network two products with a matrix that is ready before the run. Within an
interval the terms of E's series drive g's next ones: that takes three integrations at least.

Of an averaged bridge the moments of its current are among the sums. The power that it draws is
then, for its DC link, the parabola with the same mean and the same first two moments as the true
one.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray

from gfm_plant.dc_link import advance_dc_link
from gfm_plant.layout import DRIVES, LANES, MOMENTS, SPEEDS, TERMS, field
from gfm_plant.records import I_F, N_OWN, PlantRecords
from gfm_plant.solution import own
from gfm_plant.sparse import turned
from gfm_plant.vectors import (
    FOUR,
    INT,
    VOID,
    ZERO,
    add,
    add_product,
    all_four,
    rows_of,
    shuffle,
    store,
)
from gfm_runtime.compiled import compiled, inlined, intrinsic

_SLOWEST = 0.02  # rad; a source that turns further in half a unit has too few powers
_SMALLEST = 1e-15  # of a power of the norm over its factorial; further ones are left out
_NOTHING = 1e-17  # p.u.; what g adds to a current in an interval
_MORE = 8  # terms of the tables' own series
_POINTS, _WEIGHTS = (0.5 * x for x in leggauss(8))  # of Gauss's rule, in [-0.5, 0.5]
_PER_FACTORIAL = np.array([1.0 / math.factorial(j) for j in range(TERMS + 1)])
# what term q of a series, times t^l, gives t^(l + q + 1) when both are convolved
_SHARES = np.array(
    [[1.0 / ((m + 1) * math.comb(m + 1 + q, q)) for m in range(TERMS)] for q in range(TERMS)]
)


def pack_port(
    net: Any, place: int, k: int, A: NDArray[np.float64], B: NDArray[np.float64],
    free: NDArray[np.bool_], by_free: NDArray[np.float64], size: float,
) -> None:  # fmt: skip
    """Set the tables of a balanced circuit, or none if its norm asks for too many powers.

    Args:
        net: of the plant.
        place: of the tables.
        k: the switched converter.
        A, B: w' = A w + B s, 1/s, of which only the columns of ``free`` states are not zero.
        free: which states give all others.
        by_free: all states by these, in their columns.
        size: the norm of A in energy coordinates, 1/s.
    """
    half, N = 0.5 * float(net["unit_s"]), int(net["n_converters"])
    powers = next(
        (j for j in range(4, DRIVES) if (size * half) ** j < _SMALLEST * math.factorial(j)), 0
    )
    i_f, v, i_o = range(N_OWN * k, N_OWN * (k + 1))
    others = [x for x in range(len(A)) if not i_f <= x <= i_o]
    net["port_powers"][place] = 0
    if not powers or A[v, others].any():
        return
    A, B = half * A, half * B  # time in halves of a unit, from its middle
    sources = [j for j in range(B.shape[1]) if j != k and B[:, j].any()]
    drives = np.zeros(len(A))
    drives[others] = A[i_o, others] / half
    from_start = _by_start(A, B[:, sources], by_free[:, free])
    by_E = np.zeros((powers + TERMS, len(A)))  # A^m b
    by_E[0] = B[:, k]
    for m in range(1, len(by_E)):
        by_E[m] = A @ by_E[m - 1]
    table, by_moment = net["port_table"][place], net["port_moment"][place]
    table[:], by_moment[:] = 0.0, 0.0
    width = from_start.shape[2]
    table[:width, :powers] = (drives @ from_start[:powers]).T
    of_source = int(free.sum()) + SPEEDS * np.arange(len(sources))
    for j in range(min(SPEEDS, powers)):
        table[of_source + j, j] += B[i_o, sources] / half
    rows = slice(DRIVES, row := DRIVES + len(others))
    table[:width, rows] = from_start.sum(0)[others].T
    for m in range(powers):
        by_moment[m, : powers - m] = by_E[m:powers] @ drives * _PER_FACTORIAL[: powers - m]
        by_moment[m, rows] = _PER_FACTORIAL[:TERMS] @ by_E[m : m + TERMS, others]
    power = np.arange(len(from_start))
    for other in range(N):
        x = N_OWN * other + I_F
        for q in range(MOMENTS if other != k else 0):
            mean = np.where((power + q) % 2 == 0, 1.0 / (power + q + 1), 0.0)
            table[:width, row] = mean @ from_start[:, x]
            by_moment[:powers, row] = by_E[:TERMS, x] @ _weights_in_time()[q, :, :powers]
            row += 1
    sizes = np.abs(by_moment[0, :DRIVES])
    net["port_most"][place] = np.maximum.accumulate(sizes[::-1])[::-1]
    by_moment *= _PER_FACTORIAL[:DRIVES, None]
    net["port_rows"][place], net["port_powers"][place] = row, powers
    net["port_states"][place], net["port_sources"][place] = free.sum(), len(sources)
    net["port_state"][place, : free.sum()] = np.flatnonzero(free)
    net["port_source"][place, : len(sources)] = sources


def _by_start(
    A: NDArray[np.float64], B: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What w is without E: for each power of time a matrix, by the free states at the beginning and
    by the powers of each source about the middle."""
    length, n = TERMS + _MORE, len(A)
    by_middle = np.zeros((length, n, n))
    driven = np.zeros((length, n, B.shape[1] * SPEEDS))  # from zero in the middle
    by_middle[0] = np.eye(n)
    for j in range(1, length):
        by_middle[j] = A @ by_middle[j - 1] / j
        driven[j] = A @ driven[j - 1]
        if j <= SPEEDS:
            driven[j, :, j - 1 :: SPEEDS] += B
        driven[j] /= j
    to_middle = by_middle.sum(0)
    first = to_middle @ ((-1.0) ** np.arange(length) @ driven.swapaxes(0, 1))
    return np.concatenate([by_middle @ (to_middle @ start), driven - by_middle @ first], axis=2)


@cache
def _weights_in_time() -> NDArray[np.float64]:
    """What E at a time x does to the mean of t^q w over [-1, 1] by the terms of w' = A w + b E:
    half the integral from x to 1 of t^q (t - x)^j / j!, as factors of (-x)^m / m!; (q, j, m)."""
    found = np.zeros((MOMENTS, TERMS, TERMS + MOMENTS + 1))
    for q in range(MOMENTS):
        for j in range(TERMS):
            for i in range(j + 1):  # (t - x)^j t^q, integrated from x to 1, in powers of x
                n = q + j - i + 1
                c = 0.5 * math.comb(j, i) * (-1.0) ** i / n / math.factorial(j)
                found[q, j, i] += c
                found[q, j, i + n] -= c
    signs = [(-1.0) ** m * math.factorial(m) for m in range(DRIVES)]
    return found[:, :, :DRIVES] * signs


@inlined
def begin_port(plant: PlantRecords) -> bool:
    """Begin a whole unit of the carrier behind the port, if the plant can; returns whether."""
    n, now = plant.net[0], plant.now[0]
    now.behind, k = 0, n.switched
    if k < 0 or now.contact or now.joint:
        return False
    r, s = plant.par[k], plant.st[k]
    if s.trip != 0 or r.i_peak < math.inf or field(n, "port_powers")[now.row] == 0:
        return False
    return _begin(plant)


@compiled
def _begin(plant: PlantRecords) -> bool:
    n, now = plant.net[0], plant.now[0]
    place, half = now.row, 0.5 * n.unit_s
    x, y, w = field(now, "port_x"), field(now, "port_y"), field(now, "w")
    source, speed = field(now, "source"), field(now, "source_speed")
    column, which = field(n, "port_states")[place], field(n, "port_source")
    for j in range(field(n, "port_sources")[place]):
        k = which[place, j]
        angle = speed[k] * half
        if not abs(angle) < _SLOWEST:
            return False
        s = source[k] * turned(angle)
        for q in range(SPEEDS):
            x[0, column], x[1, column] = s.real, s.imag
            column += 1
            turn = angle / (q + 1)
            s = complex(-turn * s.imag, turn * s.real)
    state = field(n, "port_state")
    for j in range(field(n, "port_states")[place]):
        i = state[place, j]
        if i < own(n.n_converters):
            ends, at = plant.st[i // N_OWN].ends, 2 * (i % N_OWN)
            x[0, j], x[1, j] = ends[0, at], ends[0, at + 1]
        else:
            x[0, j], x[1, j] = w[i].real, w[i].imag
    rows, moments = field(n, "port_rows")[place], field(now, "port_moments")
    for row in range(rows):
        y[0, row] = y[1, row] = 0.0
    add_product(field(n, "port_table")[place], column, 0, rows, x, y)
    for m in range(DRIVES):
        moments[0, m] = moments[1, m] = 0.0
    now.behind = 1
    return True


@intrinsic
def _shift(typingctx: Any, y: Any, powers: Any, middle: Any, part: Any, g: Any) -> Any:
    """Write to g, (2, LANES), the powers of tau of the sum of y_j (middle + part tau)^j."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, blocks = signature.args, range(LANES // 4)
        y, y_width = rows_of(context, builder, kinds[0], arguments[0])
        g, g_width = rows_of(context, builder, kinds[4], arguments[4])
        middle, part = (all_four(builder, one) for one in arguments[2:4])
        powers, sums = (
            [cgutils.alloca_once_value(builder, ZERO) for _ in range(n * LANES // 4)]
            for n in (1, 2)
        )  # fmt: skip
        # (middle + part tau)^j
        builder.store(ir.Constant(FOUR, [1.0, 0.0, 0.0, 0.0]), powers[0])
        with cgutils.for_range(builder, arguments[1]) as loop:
            now = [builder.load(one) for one in powers]
            for axis in range(2):
                place = builder.add(loop.index, y_width) if axis else loop.index
                value = all_four(builder, builder.load(builder.gep(y, [place])))
                for b in blocks:
                    to = sums[axis * len(blocks) + b]
                    builder.store(add(builder, now[b], value, builder.load(to)), to)
            for b in blocks:
                before = shuffle(builder, now[b - 1] if b else ZERO, now[b], [3, 4, 5, 6])
                next_one = add(builder, before, part, builder.fmul(now[b], middle))
                builder.store(next_one, powers[b])
        for axis in range(2):
            for b in blocks:
                place = builder.add(g_width, INT(4 * b)) if axis else INT(4 * b)
                store(builder, builder.load(sums[axis * len(blocks) + b]), g, place)
        return context.get_dummy_value()

    real = types.float64
    return types.void(y, types.int64, real, real, g), make


@intrinsic
def _find_moments(
    typingctx: Any, E: Any, terms: Any, tau: Any, first: Any, length: Any, powers: Any, more: Any
) -> Any:
    """Write to ``more``, (2, .), the integrals of E (-x)^m from x = first on over a length, in
    which E is the sum of E_j (tau t)^j, t in [0, 1]; by Gauss's rule."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kinds, blocks = signature.args, range(2)
        E, E_width = rows_of(context, builder, kinds[0], arguments[0])
        more, width = rows_of(context, builder, kinds[6], arguments[6])
        terms, _, _, _, powers = arguments[1:6]
        tau, first, length = (all_four(builder, one) for one in arguments[2:5])
        points = [ir.Constant(FOUR, list(_POINTS[4 * b : 4 * b + 4] + 0.5)) for b in blocks]
        weights = [ir.Constant(FOUR, list(_WEIGHTS[4 * b : 4 * b + 4])) for b in blocks]
        sums = [cgutils.alloca_once_value(builder, ZERO) for _ in range(4)]
        at = [builder.fmul(one, tau) for one in points]
        last = builder.sub(terms, INT(1))
        with cgutils.for_range(builder, terms) as loop:
            j = builder.sub(last, loop.index)
            for axis in range(2):
                place = builder.add(j, E_width) if axis else j
                value = all_four(builder, builder.load(builder.gep(E, [place])))
                for b in blocks:
                    to = sums[2 * axis + b]
                    builder.store(add(builder, builder.load(to), at[b], value), to)
        for axis in range(2):
            for b in blocks:
                to = sums[2 * axis + b]
                weight = builder.fmul(weights[b], length)
                builder.store(builder.fmul(builder.load(to), weight), to)
        back = [
            builder.fsub(builder.fsub(ZERO, first), builder.fmul(one, length)) for one in points
        ]
        with cgutils.for_range(builder, powers) as loop:
            now = [builder.load(one) for one in sums]
            a, b = builder.fadd(now[0], now[1]), builder.fadd(now[2], now[3])
            pairs = builder.fadd(
                shuffle(builder, a, b, [0, 1, 4, 5]), shuffle(builder, a, b, [2, 3, 6, 7])
            )
            both = builder.fadd(
                shuffle(builder, pairs, VOID, [0, 2]), shuffle(builder, pairs, VOID, [1, 3])
            )
            for axis in range(2):
                place = builder.add(loop.index, width) if axis else loop.index
                builder.store(builder.extract_element(both, INT(axis)), builder.gep(more, [place]))
            for j, one in enumerate(sums):
                builder.store(builder.fmul(now[j], back[j % 2]), one)
        return context.get_dummy_value()

    real, whole = types.float64, types.int64
    return types.void(E, whole, real, real, real, whole, more), make


@inlined
def drive_port(plant: PlantRecords, h: float, t: float) -> None:
    """Set the terms of g over an interval of h s from t on as its beginning says."""
    n, now = plant.net[0], plant.now[0]
    powers, per_half = field(n, "port_powers")[now.row], 2.0 / n.unit_s
    _shift(field(now, "port_y"), powers, t * per_half - 1.0, h * per_half, field(now, "port_g"))


@inlined
def drive_by_itself(plant: PlantRecords, h: float, terms: int, q: int) -> None:
    """Add to the terms of g in the interval what term q of E does to them."""
    n, now = plant.net[0], plant.now[0]
    g, E, by = field(now, "port_g"), field(now, "port_E"), field(n, "port_moment")[now.row]
    part, most = 2.0 * h / n.unit_s, field(n, "port_most")[now.row]
    E_a, E_b, factor = E[0, q], E[1, q], part * part * part
    size = h * (abs(E_a) + abs(E_b))
    for j in range(2, min(terms - 1 - q, field(n, "port_powers")[now.row])):
        if factor * size * most[j] < _NOTHING:
            break
        per = factor * by[0, j] * _SHARES[q, j]
        g[0, j + 1 + q] += per * E_a
        g[1, j + 1 + q] += per * E_b
        factor *= part


@inlined
def keep_moments(plant: PlantRecords, h: float, t: float, terms: int, tau: float) -> None:
    """Add the moments of E in a part tau of an interval of h s from t on."""
    n, now = plant.net[0], plant.now[0]
    k, per_half, powers = n.switched, 2.0 / n.unit_s, field(n, "port_powers")[now.row]
    r, s = plant.par[k], plant.st[k]
    if (
        r.cancels
        and s.open < 0
        and s.by_mid == 0j
        and abs(s.by_dc.real) + abs(s.by_dc.imag) < 1e-14
    ):
        return  # all legs are at one rail
    moments, more = field(now, "port_moments"), field(now, "port_more")
    _find_moments(
        field(now, "port_E"), terms, tau, t * per_half - 1.0, tau * h * per_half, powers, more
    )
    for m in range(powers):
        moments[0, m] += more[0, m]
        moments[1, m] += more[1, m]
    y = field(now, "port_y")
    add_product(field(n, "port_moment")[now.row], powers, 0, powers, more, y)


@compiled
def end_port(plant: PlantRecords) -> None:
    """End the unit: take the network's other states, the sources, and the averaged DC links on."""
    n, now = plant.net[0], plant.now[0]
    now.behind = 0
    place, k, half = now.row, n.switched, 0.5 * n.unit_s
    y, w, powers = field(now, "port_y"), field(now, "w"), field(n, "port_powers")[place]
    add_product(
        field(n, "port_moment")[place], powers, DRIVES, field(n, "port_rows")[place],
        field(now, "port_moments"), y,
    )  # fmt: skip
    row = DRIVES
    for i in range(n.n_states):
        if own(k) <= i < own(k + 1):
            continue
        if i < own(n.n_converters):
            ends, at = plant.st[i // N_OWN].ends, 2 * (i % N_OWN)
            ends[0, at], ends[0, at + 1] = y[0, row], y[1, row]
        else:
            w[i] = complex(y[0, row], y[1, row])
        row += 1
    source, speed = field(now, "source"), field(now, "source_speed")
    for j in range(now.n_s):
        turn = turned(speed[j] * half)
        middle = source[j] * turn
        if j < n.n_converters and j != k:
            _advance_link(plant, j, row, middle)
            row += MOMENTS
        source[j] = middle * turn


@inlined
def _advance_link(plant: PlantRecords, k: int, row: int, E: complex) -> None:
    """Take the DC link of an averaged bridge on by a unit, by the moments of its current, from a
    row of the sums on, and its voltage in the middle."""
    n, now, r, s = plant.net[0], plant.now[0], plant.par[k], plant.st[k]
    half, y = 0.5 * n.unit_s, field(now, "port_y")
    angle = field(now, "source_speed")[k] * half
    p_0 = p_1 = p_2 = 0.0
    F = complex(r.current * E.real, r.current * E.imag)
    for q in range(MOMENTS):
        p_0 += F.real * y[0, row + q] + F.imag * y[1, row + q]
        if q + 1 < MOMENTS:
            p_1 += F.real * y[0, row + q + 1] + F.imag * y[1, row + q + 1]
        if q + 2 < MOMENTS:
            p_2 += F.real * y[0, row + q + 2] + F.imag * y[1, row + q + 2]
        turn = angle / (q + 1)
        F = complex(-turn * F.imag, turn * F.real)
    square = 11.25 * (p_2 - p_0 / 3.0)
    mean, slope = p_0 - square / 3.0, 3.0 * p_1
    pieces = field(n, "pieces")[0]
    for piece in range(pieces):
        for j in range(3):
            x = (2.0 * piece + j) / pieces - 1.0
            s.drawn[j] = mean + x * (slope + x * square)
        advance_dc_link(r, s, half / pieces)
