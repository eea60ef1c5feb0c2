"""A law in fixed point: its word lengths and scalings, and an exact reference of its arithmetic.

Every number is an int32, a value in p.u. times 2^q. Sums of products are int64 at one exponent e a
row: the largest e at which no sum, whatever its inputs are within their ranges, reaches 2^62, and
every coefficient is an int32. Ranges come from the signal table, and for the states from

* the l1 norm of the row's states, with its clamp as a gain between 0 and 1 (anti-windup included):
  a sector in the l1 norm, Desoer and Vidyasagar, "Feedback Systems" (1975), section III.2;
* for a row with one state, an integrator among them, the interval that it cannot leave, since the
  anti-windup pulls it back where the row's output is limited;
* the states that a bumpless change can set.

A state takes the upper bits of each increment, and keeps the others for the next tick ("fraction
saving": error feedback of the first order), so that no dead band holds it away from its rest.
``FixedLaw`` is the only source of the C code (``fixed_c``), of the exact reference (``Instance``)
and of the bounds (``deviation``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE, LINEAR, V_MIN
from gfm_runtime.errors import LawError
from gfm_runtime.signals import NU, NY, U_NAMES, Signal, group
from gfm_runtime.states import BAD_Y, OK

FIXED = "fixed"
WORD = 2**31 - 1  # the largest int32
SUM = 2**62  # no sum of products reaches it; one bit is left for what is added to it
MOST_SHIFT = 60  # from a state's increments to the state
SMALL = 2.0**-6  # p.u.; the offset of a row with states only takes what rounding leaves

Matrix = NDArray[np.float64]
Span = tuple[float, float]

# places in the list of a tick's numbers
REF, Y, R, M, U, EXCESS, LAST, TREND, OFFSET, X = 0, 5, 10, 15, 20, 23, 26, 29, 32, 35
OMEGA = 2  # column of y that is the law's own omega_u


class Number(NamedTuple):
    """An int32 of the C code.

    Attributes:
        text: in C.
        q: its value is the integer times 2^-q, in p.u.
        low, high: the integers between which it stays.
    """

    text: str
    q: int
    low: int
    high: int

    @property
    def span(self) -> Span:
        """Its range in p.u."""
        return math.ldexp(self.low, -self.q), math.ldexp(self.high, -self.q)


class Sum(NamedTuple):
    """A sum of products at one exponent.

    Attributes:
        e: its value is the integer times 2^-e.
        start: the constant.
        terms: coefficient and place of each number; none is 0.
        meant: the coefficients in real numbers by place, those that round to 0 too.
        meant_start: the constant in real numbers.
    """

    e: int
    start: int
    terms: tuple[tuple[int, int], ...]
    meant: Mapping[int, float]
    meant_start: float

    def __call__(self, values: Sequence[int]) -> int:
        """The integer, from all numbers of a tick."""
        total = self.start
        for coefficient, place in self.terms:
            total += coefficient * values[place]
        return total


@dataclass(frozen=True)
class FixedLaw:
    """A law's numbers and sums.

    Attributes:
        n: states.
        numbers: of a tick, by place (REF, Y, ...); a place without a number has None.
        low, high: limits of u, as integers of u.
        output: u before its limits, at each row's exponent.
        state: increments of x.
        decay, follow: increments of the offset and of the trend.
        settle: x at a bumpless change.
        last: u of the tick before a bumpless change.
        error_map: its code.
        across: of hybrid-angle, for the references and for the measurements.
    """

    n: int
    numbers: tuple[Number, ...]
    low: tuple[int, ...]
    high: tuple[int, ...]
    output: tuple[Sum, ...]
    state: tuple[Sum, ...]
    decay: tuple[Sum, ...]
    follow: tuple[Sum, ...]
    settle: tuple[Sum, ...]
    last: tuple[Sum, ...]
    error_map: int
    across: tuple[Across, ...] = ()

    def shift(self, total: Sum, place: int) -> int:
        """Bits from a sum to the number at a place."""
        return total.e - self.numbers[place].q

    def moving(self) -> list[tuple[Sum, int]]:
        """Of all that moves from tick to tick: its increment and its place."""
        return [
            *((total, OFFSET + i) for i, total in enumerate(self.decay)),
            *((total, TREND + i) for i, total in enumerate(self.follow)),
            *((total, X + k) for k, total in enumerate(self.state)),
        ]

    def halves(self) -> list[int]:
        """The rests from which they begin: half a unit, the middle of what a rest can be."""
        return [1 << (self.shift(total, place) - 1) for total, place in self.moving()]


def number(text: str, low: float, high: float) -> Number:
    """The finest int32 that holds a range, p.u."""
    most = max(abs(low), abs(high), 2.0**-30)
    q = 30 - math.frexp(most)[1]
    q += int(math.ldexp(most, q + 1) <= WORD)
    return Number(text, q, math.ceil(math.ldexp(low, q)), math.floor(math.ldexp(high, q)))


def of_signal(text: str, signal: Signal) -> Number:
    """The number of a row of the signal table."""
    return number(text, signal.low, signal.high)


def trends(follow: float) -> tuple[Number, ...]:
    """The numbers of the trends, whose filter moves by ``follow`` in a tick.

    The trend is ``follow`` times the distance between u and its filtered value, so it is at most
    ``follow`` times the range of u. A power of two above that is in the numbers' range.
    """
    most = math.ldexp(1.0, math.ceil(math.log2(follow)))
    return tuple(
        number(f"s->trend[{i}]", most * (s.low - s.high), most * (s.high - s.low))
        for i, s in enumerate(group("u"))
    )


#: of what goes over the interface, the same for all laws
REFS = tuple(of_signal(f"t->ref[{j}]", s) for j, s in enumerate(group("ref")))
YS = tuple(of_signal(f"t->y[{j}]", s) for j, s in enumerate(group("y")))
US = tuple(of_signal(f"t->u[{i}]", s) for i, s in enumerate(group("u")))
U_DEFAULT = tuple(
    round(math.ldexp(s.default, one.q)) for s, one in zip(group("u"), US, strict=True)
)
BUMP_Q = min(one.q for one in US) - 1  # two u may be as far apart as their range is wide


def span_of(meant: Mapping[int, float], numbers: Mapping[int, Number], start: float = 0.0) -> Span:
    """The interval of a sum of products, p.u."""
    low = high = start
    for place, c in meant.items():
        ends = [c * end for end in numbers[place].span]
        low, high = low + min(ends), high + max(ends)
    return low, high


def most(span: Span) -> float:
    """The largest magnitude in an interval."""
    return max(abs(span[0]), abs(span[1]))


def make_sum(
    meant: Mapping[int, float],
    numbers: Mapping[int, Number],
    start: float = 0.0,
    beside: float = 0.0,
    most_e: int = 120,
) -> Sum:
    """A sum at the largest exponent that fits.

    A reference and a measurement with opposite coefficients get integers that cancel exactly.

    Args:
        meant: the coefficients by place.
        start: the constant, p.u.
        beside: what else is added to the sum in the same exponent, p.u.
        most_e: the largest exponent that is allowed.
    """
    meant = {place: c for place, c in meant.items() if c != 0.0}
    sizes = {place: max(-numbers[place].low, numbers[place].high) for place in meant}

    def fits(e: int) -> bool:
        coefficients = {p: abs(math.ldexp(c, e - numbers[p].q)) + 1 for p, c in meant.items()}
        total = sum(c * sizes[p] for p, c in coefficients.items())
        total += math.ldexp(abs(start) + beside, e)
        return total < SUM and all(c < WORD for c in coefficients.values())

    e = most_e
    while not fits(e):
        e -= 1
    rounded = {p: round(math.ldexp(c, e - numbers[p].q)) for p, c in meant.items()}
    for j in range(NY):
        for r, y in ((REF + j, Y + j), (R + j, M + j)):
            if meant.get(r) and meant.get(r) == -meant.get(y, 0.0):
                q = max(numbers[r].q, numbers[y].q)
                steps = round(math.ldexp(meant[r], e - q))
                rounded[r], rounded[y] = (
                    sign * steps * 2 ** (q - numbers[p].q) for sign, p in ((1, r), (-1, y))
                )
    terms = tuple((c, p) for p, c in rounded.items() if c)
    return Sum(e, round(math.ldexp(start, e)), terms, meant, start)


# --- ranges of states ---


def powers(A: Matrix) -> tuple[Matrix, Matrix]:
    """Upper bounds of the sum over m of |A^m| and of its supremum, element by element.

    Beyond M powers |A^(Mp+m)| <= |A^m| |A^M|^p bounds the rest.

    Raises:
        ValueError: the powers do not die away.
    """
    n = len(A)
    stack, step = np.eye(n)[None], A.copy()
    for _ in range(18):
        stack, step = np.concatenate([stack, stack @ step]), step @ step
        Q = np.abs(step)
        if len(stack) >= 2048 and np.max(np.abs(np.linalg.eigvals(Q)), initial=0.0) < 0.9:
            tail = np.linalg.inv(np.eye(n) - Q) * (1 + 1e-9)  # and what the sums here round
            many = np.abs(stack)
            return many.sum(axis=0) @ tail, many.max(axis=0) @ tail
    raise ValueError


class Block(NamedTuple):
    """The states of one row: x' = A (x + W excess) + ..., raw = c x + ..."""

    A: Matrix
    c: Matrix
    W: Matrix


def _one_state(block: Block, d: Span, forced: Span, low: float, high: float) -> Span | None:
    """The interval that one state cannot leave from within: d and ``forced`` are what the inputs
    add to raw and to the next x. None if it has no such interval."""
    a, c, w = float(block.A[0, 0]), float(block.c[0]), float(block.W[0])
    a = 1.0 if abs(a - 1.0) < 1e-12 else a
    if not (0 < a <= 1 and c > 0 and 0 <= w * c <= 1 and (a < 1 or w > 0)):
        return None

    def upper(high: float, d_low: float, forced: float) -> float:
        if a < 1 and c * forced / (1 - a) + d_low <= high:
            return forced / (1 - a)
        return (a * w * (high - d_low) + forced) / (1 - a * (1 - w * c))

    return -upper(-low, -d[1], -forced[0]), upper(high, d[0], forced[1])


def sector(block: Block, feedback: Matrix | float = 0.0) -> tuple[Matrix, Matrix, Matrix, float]:
    """A clamped row as a loop about the middle of its sector.

    The clamp passes 1 - theta of a change of raw, 0 <= theta <= 1: what the anti-windup and an
    omega_u that is fed back (``feedback``, its column of B) add to x is written as that for theta =
    1/2 and a rest of at most half as much.

    Returns:
        A about the middle; bounds of the sum and of the supremum of |A^m|; and the gain of the loop
        through the rest, below 1 if the bound exists.

    Raises:
        ValueError: the powers of A do not die away.
    """
    A, c, W = block
    pull = A @ W
    middle = A - np.outer(pull - feedback, c) / 2
    total, peak = powers(middle)
    gain = 0.0
    if len(A) == 1:
        gain = float(np.abs(c) @ total @ np.abs(pull + feedback)) / 2
    else:
        row, h = c, (pull + feedback) / 2
        for _ in range(200_000):
            gain += abs(float(row @ h))
            row = row @ middle
            if float(np.abs(row) @ total @ np.abs(h)) < 1e-6:
                break
        gain += float(np.abs(row) @ total @ np.abs(h))
    return middle, total, peak, gain


def _many_states(
    block: Block, d: Span, forced: Matrix, first: Matrix, low: float, high: float
) -> Matrix | None:
    """The largest |x| of a row's states from |x| <= ``first`` on, whatever its clamp does."""
    try:
        _, total, peak, gain = sector(block)
    except ValueError:
        return None
    if gain >= 1 - 1e-6:
        return None
    c, pull = np.abs(block.c), np.abs(block.A @ block.W)
    aside = most((d[0] - (low + high) / 2, d[1] - (low + high) / 2))  # raw - middle without x
    inputs = forced + pull * aside / 2
    raw = (c @ (peak @ first + total @ inputs) + aside) / (1 - gain)
    return np.asarray(peak @ first + total @ (inputs + pull * raw / 2))


# --- error maps ---

G_MOST = 60.0  # p.u.; where p/V^2 and q/V^2 of dvoc saturate
QUOTIENT = 31  # exponent of p/V on the way to p/V^2


def _mapped(code: int) -> dict[int, Number] | None:
    """The numbers of the columns that an error map changes; None if it is not covered."""
    if code == LINEAR:
        return {}
    if code == DC_ENERGY:
        (low, high), most_y = REFS[0].span, YS[0].span[1]
        return {
            R: number("t->r[0]", low * low / 2, high * high / 2),
            M: number("t->m[0]", 0.0, most_y * most_y / 2),
        }
    if code == DVOC:
        return {
            place + j: number(f"t->{name}[{j}]", -G_MOST, G_MOST)
            for place, name in ((R, "r"), (M, "m"))
            for j in (1, 3)
        }
    if code == HYBRID_ANGLE:
        return {R + 1: number("t->r[1]", -1.0, 1.0)}
    return None


class Ratio(NamedTuple):
    """What p/V^2 is computed with: the least V, the shifts before the two divisions, and where the
    first quotient saturates, so that the second numerator fits."""

    least: int
    first: int
    most: int
    second: int


def ratio_of(p: Number, V: Number, out: Number) -> Ratio:
    """Of the numbers p and V, for the number p/V^2."""
    most = math.ceil(math.ldexp(V.span[1] * G_MOST, QUOTIENT))
    return Ratio(round(math.ldexp(V_MIN, V.q)), QUOTIENT + V.q - p.q, most, V.q + out.q - QUOTIENT)


class Across(NamedTuple):
    """The integers R and X (p.u.) that p and q are multiplied with, at the exponent of V^2."""

    R: int
    X: int


def across(parameters: Sequence[float], p: Number, V: Number) -> Across:
    """For the numbers p (and q) and V."""
    return Across(*(round(math.ldexp(float(one), 2 * V.q - p.q)) for one in parameters))


def _direction(x: int, y: int) -> tuple[int, int]:
    """A vector's direction as two integers up to 2^30, the larger at least 2^29; or (0, 0)."""
    if x or y:
        for bits in (32, 16, 8, 4, 2, 1):
            if max(abs(x), abs(y)) < 1 << (62 - bits):
                x, y = x << bits, y << bits
    return x >> 32, y >> 32


ONE = 1 << 30  # of sines and cosines


def sine_of_half(x_a: int, y_a: int, x_b: int, y_b: int) -> int:
    """As ``error_maps``, from vectors at any exponent: sin((a - b)/2) 2^30."""
    a_below, b_below = y_a < 0, y_b < 0
    (x_a, y_a), (x_b, y_b) = _direction(x_a, y_a), _direction(x_b, y_b)
    if not (x_a or y_a) or not (x_b or y_b):
        return 0
    dot, cross = x_a * x_b + y_a * y_b, y_a * x_b - x_a * y_b
    d, c = map(abs, _direction(dot, cross))
    length = max(math.isqrt(d * d + c * c), ONE // 2)
    larger = max(math.isqrt((ONE + min(d * ONE // length, ONE)) * (ONE // 2)), ONE // 2)
    sine = min(c * ONE // length, ONE) * (ONE // 2) // larger if dot >= 0 else larger
    return -sine if (cross < 0 if a_below == b_below else a_below) else sine


def divided(a: int, b: int) -> int:
    """a/b towards 0, as C divides; b > 0."""
    return a // b if a >= 0 else -(-a // b)


def map_integers(
    law: FixedLaw, ref: Sequence[int], y: Sequence[int]
) -> tuple[Sequence[int], Sequence[int]]:
    """References and measurements after the error map."""
    if law.error_map == LINEAR:
        return ref, y
    out = []
    for values, many, place in ((ref, REFS, R), (y, YS, M)):
        now = list(values)
        if law.error_map == DC_ENERGY:
            now[0] = rounded(now[0] * now[0], 2 * many[0].q + 1 - law.numbers[place].q)
        if law.error_map == DVOC:
            for j in (1, 3):
                one = law.numbers[place + j]
                of = ratio_of(many[j], many[4], one)
                V = max(values[4], of.least)
                quotient = divided(values[j] << of.first, V)
                quotient = min(max(quotient, -of.most), of.most)
                now[j] = between(divided(quotient << of.second, V), one)
        out.append(now)
    if law.error_map == HYBRID_ANGLE:
        vectors: list[int] = []
        for (_, p, _, q, V), (R_pu, X_pu) in zip((ref, y), law.across, strict=True):
            vectors += [V * V - (R_pu * p + X_pu * q), X_pu * p - R_pu * q]
        out[0][1] = sine_of_half(*vectors)
    return out[0], out[1]


# --- a law ---


def _row_of(values: Matrix, place: int, leave: int = -1) -> dict[int, float]:
    return {place + j: float(v) for j, v in enumerate(values) if j != leave and v != 0.0}


def _merged(*parts: Mapping[int, float]) -> dict[int, float]:
    out: dict[int, float] = {}
    for part in parts:
        for place, c in part.items():
            out[place] = out.get(place, 0.0) + c
    return out


def make_fixed(name: str, record: np.void) -> FixedLaw:
    """A law in fixed point.

    Args:
        name: for messages.
        record: as ``gfm_runtime.kernel.pack_law`` gives it in float64.

    Raises:
        LawError: what fixed point does not cover, or ranges that it cannot hold.
    """
    where = f"law {name!r} in fixed point"
    n, code = int(record["n"]), int(record["error_map"])
    mapped = _mapped(code)
    if mapped is None:
        raise LawError(where, "its error map is not covered")
    f: dict[str, Matrix] = {
        key: np.asarray(record[key], np.float64)
        for key in ("B_r", "B_y", "C", "D_r", "D_y", "D_u0", "u_0", "low", "high", "W", "E_r",
                    "E_y", "F", "G")
    }  # fmt: skip
    A, rows = np.asarray(record["A"][:n, :n], np.float64), record["row"][:n]
    loop = float(record["loop"])
    r, m = (R, M) if mapped else (REF, Y)  # places of the mapped inputs
    numbers: dict[int, Number] = {}
    fade, follow = 1.0 - float(record["decay"]), float(record["follow"])
    for place, many in ((REF, REFS), (Y, YS), (U, US), (TREND, trends(follow))):
        numbers |= {place + k: one for k, one in enumerate(many)}
    if mapped:
        numbers |= {R + j: one for j, one in enumerate(REFS)} | {
            M + j: one for j, one in enumerate(YS)
        }
        numbers |= mapped
    impedances: tuple[Across, ...] = ()
    if code == HYBRID_ANGLE:
        impedances = tuple(
            across(record["error_parameters"], many[1], many[4]) for many in (REFS, YS)
        )
        for impedance, many in zip(impedances, (REFS, YS), strict=True):
            size = abs(impedance.R) + abs(impedance.X)
            if size > WORD or many[4].high ** 2 + size * many[1].high >= SUM:
                raise LawError(where, "R and X of its error map must be less than 1 p.u. in all")
        for key in ("B_y", "D_y", "E_y"):  # the map has the difference in r
            f[key] = f[key] * [1, 0, 1, 1, 1]
    numbers |= {
        LAST + i: Number(f"s->u[{i}]", one.q, one.low, one.high) for i, one in enumerate(US)
    }
    lows, highs = [], []
    for i, one in enumerate(US):
        low, high = f["low"][i], f["high"][i]
        if not one.span[0] - 1e-9 <= low < high <= one.span[1] + 1e-9:
            raise LawError(
                where,
                f"limits.{U_NAMES[i]} = [{low:g}, {high:g}] must lie in the signal table's range, "
                f"{one.span[0]:.3g} to {one.span[1]:.3g} p.u.",
            )
        lows.append(max(one.low, math.ceil(math.ldexp(low, one.q))))
        highs.append(min(one.high, math.floor(math.ldexp(high, one.q))))
    limited = {
        U + i: Number(one.text, one.q, lows[i], highs[i]) for i, one in enumerate(US)
    }  # as the sums of a step see u
    outputs: list[Sum] = []
    for i in range(NU):
        gain = loop if i == OMEGA - 1 else 1.0
        own = [int(k) for k in np.flatnonzero(rows == i)]
        on_d = _merged(
            _row_of(gain * f["D_u0"][i], REF),
            _row_of(gain * f["D_r"][i], r),
            _row_of(gain * f["D_y"][i], m, OMEGA),
            {U + OMEGA - 1: float(f["D_y"][i, OMEGA])} if i != OMEGA - 1 else {},
        )
        on_d = {place: c for place, c in on_d.items() if c != 0.0}
        start = gain * float(f["u_0"][i])
        d = span_of(on_d, numbers | limited, start)
        room = SMALL if len(own) else most(d) + most(US[i].span)
        numbers[OFFSET + i] = number(f"s->offset[{i}]", -room, room)
        d = d[0] - room, d[1] + room
        block = Block(A[np.ix_(own, own)], gain * f["C"][i, own], f["W"][own, i])
        forced = [
            span_of(
                _merged(_row_of(f["B_r"][k], r), _row_of(f["B_y"][k], m, OMEGA),
                        {U + OMEGA - 1: float(f["B_y"][k, OMEGA])}),
                numbers | limited,
            )
            for k in own
        ]  # fmt: skip
        first = [span_of(*_settling(f, k, r, m, numbers)) for k in own]
        for k, span in zip(own, _ranges(block, d, forced, first, f, i), strict=True):
            if span is None:
                raise LawError(
                    where,
                    f"the row of {U_NAMES[i]} has an integrator beside other states, or none that "
                    "the anti-windup holds: its states have no bound that is proven",
                )
            numbers[X + k] = number(f"s->x[{k}]", *span)
        on_raw = _merged({OFFSET + i: 1.0}, {X + k: float(gain * f["C"][i, k]) for k in own}, on_d)
        total = make_sum(on_raw, numbers | limited, start, beside=most(US[i].span))
        outputs.append(total)
        raw = span_of(on_raw, numbers | limited, start)
        low, high = limited[U + i].span
        numbers[EXCESS + i] = number(
            f"t->excess[{i}]", min(0.0, high - raw[1]), max(0.0, low - raw[0])
        )
    seen = numbers | limited
    states = []
    for k in range(n):
        i = int(rows[k])
        pull = float((A @ f["W"][:n])[k, i])
        meant = _merged(
            {X + j: float(A[k, j] - (j == k)) for j in range(n)},
            {EXCESS + i: pull},
            _row_of(f["B_r"][k], r),
            _row_of(f["B_y"][k], m, OMEGA),
            {U + OMEGA - 1: float(f["B_y"][k, OMEGA])},
        )
        states.append(make_sum(meant, seen, most_e=numbers[X + k].q + MOST_SHIFT))
    law = FixedLaw(
        n,
        tuple(numbers.get(place, Number("", 0, 0, 0)) for place in range(X + n)),
        tuple(lows),
        tuple(highs),
        tuple(outputs),
        tuple(states),
        tuple(
            make_sum({OFFSET + i: -fade}, numbers, most_e=numbers[OFFSET + i].q + MOST_SHIFT)
            for i in range(NU)
        ),
        tuple(
            make_sum(
                {TREND + i: -follow, U + i: follow, LAST + i: -follow},
                numbers,
                most_e=numbers[TREND + i].q + MOST_SHIFT,
            )
            for i in range(NU)
        ),
        tuple(make_sum(*_settling(f, k, r, m, numbers)) for k in range(n)),
        tuple(make_sum({U + i: 1.0, TREND + i: -1.0}, numbers) for i in range(NU)),
        code,
        impedances,
    )
    _check(where, law)
    return law


def _settling(
    f: Mapping[str, Matrix], k: int, r: int, m: int, numbers: Mapping[int, Number]
) -> tuple[dict[int, float], Mapping[int, Number], float]:
    """The arguments of the sum that sets state k at a bumpless change."""
    F = f["F"][k]
    meant = _merged(
        _row_of(f["E_r"][k], r),
        _row_of(f["E_y"][k], m, OMEGA),
        {U + OMEGA - 1: float(f["E_y"][k, OMEGA])},
        _row_of(F, U),
        _row_of(-F @ f["D_u0"], REF),
        _row_of(f["G"][k], TREND),
    )
    return meant, numbers, -float(F @ f["u_0"])


def _ranges(
    block: Block,
    d: Span,
    forced: Sequence[Span],
    first: Sequence[Span],
    f: Mapping[str, Matrix],
    i: int,
) -> list[Span | None]:
    """Of a row's states: from where a bumpless change sets them, to where they can get."""
    if not forced:
        return []
    low, high = float(f["low"][i]), float(f["high"][i])
    if len(forced) == 1:
        kept = _one_state(block, d, forced[0], low, high)
        if kept is not None:
            return [(min(0.0, kept[0], first[0][0]), max(0.0, kept[1], first[0][1]))]
    sizes = _many_states(
        block, d, np.array(list(map(most, forced))), np.array(list(map(most, first))), low, high
    )
    return [None] * len(forced) if sizes is None else [(-float(x), float(x)) for x in sizes]


def _check(where: str, law: FixedLaw) -> None:
    """Refuse what no exponent fits."""
    groups = ((law.output, U), (law.output, EXCESS), (law.output, OFFSET), (law.state, X),
              (law.decay, OFFSET), (law.follow, TREND), (law.settle, X), (law.last, U))  # fmt: skip
    for sums, place in groups:
        for k, total in enumerate(sums):
            shift = law.shift(total, place + k)
            if not 1 <= shift <= MOST_SHIFT:
                raise LawError(
                    where, f"{law.numbers[place + k].text} has a range that no exponent fits"
                )


# --- the exact reference ---


def rounded(total: int, shift: int) -> int:
    """total 2^-shift, rounded to the nearest, halves up."""
    return (total + (1 << shift >> 1)) >> shift


def between(value: int, one: Number) -> int:
    """The value in a number's range."""
    return min(max(value, one.low), one.high)


class Instance:
    """An instance of a law in Python's integers, as the C code has it.

    Attributes:
        law: its numbers and sums.
        x, offset, u, trend: as the C struct's.
        rest: what the increments left below the offset, the trend and x.
        raw: u before its limits in the last output, at each row's exponent.
    """

    def __init__(self, law: FixedLaw) -> None:
        self.law = law
        self.u = [
            round(math.ldexp(s.default, one.q)) for s, one in zip(group("u"), US, strict=True)
        ]
        self.raw = [0] * NU
        self.reset()

    def reset(self) -> None:
        """States 0; the last u stays."""
        self.x, self.offset, self.trend = [0] * self.law.n, [0] * NU, [0] * NU
        self.rest = self.law.halves()

    def _values(self, ref: Sequence[int], y: Sequence[int], u: Sequence[int]) -> list[int]:
        r, m = map_integers(self.law, ref, y)
        state = (*self.u, *self.trend, *self.offset, *self.x)
        return [*ref, *y, *r, *m, *u, 0, 0, 0, *state]

    def output(self, ref: Sequence[int], y: Sequence[int]) -> list[int]:
        """All numbers of a tick up to u and the excess."""
        law, v = self.law, self._values(ref, y, (0, 0, 0))
        for i in (1, 0, 2):
            total, one = law.output[i], law.numbers[U + i]
            raw = self.raw[i] = total(v)
            shift = total.e - one.q
            to_excess = law.shift(total, EXCESS + i)
            low, high = law.low[i] << shift, law.high[i] << shift
            if raw > high:
                v[U + i], v[EXCESS + i] = law.high[i], rounded(high - raw, to_excess)
            elif raw < low:
                v[U + i], v[EXCESS + i] = law.low[i], rounded(low - raw, to_excess)
            else:
                v[U + i] = rounded(raw, shift)
        return v

    def step(self, ref: Sequence[int], y: Sequence[int]) -> list[int]:
        """One tick; u."""
        law, v = self.law, self.output(ref, y)
        moved = []
        for k, (total, place) in enumerate(law.moving()):
            shift = law.shift(total, place)
            now = self.rest[k] + total(v)
            moved.append(between(v[place] + (now >> shift), law.numbers[place]))
            self.rest[k] = now & ((1 << shift) - 1)
        self.offset, self.trend, self.x = moved[:NU], moved[NU : 2 * NU], moved[2 * NU :]
        self.u = v[U : U + NU]
        return self.u

    def settle(
        self, ref: Sequence[int], y: Sequence[int], u: Sequence[int], trend: Sequence[int]
    ) -> list[int]:
        """Set the state so that u comes out and goes on with the trend; what comes out."""
        law = self.law
        wanted = [between(value, one) for value, one in zip(u, US, strict=True)]
        self.reset()
        self.trend = [
            between(value, one)
            for value, one in zip(trend, self.law.numbers[TREND : TREND + NU], strict=True)
        ]
        v = self._values(ref, y, wanted)
        self.u = [
            between(rounded(s(v), law.shift(s, U + i)), US[i]) for i, s in enumerate(law.last)
        ]
        self.x = [
            between(rounded(s(v), law.shift(s, X + k)), law.numbers[X + k])
            for k, s in enumerate(law.settle)
        ]
        for rows in ((1,), (0, 2), ()):  # omega_u first: column 3 takes it to the others
            out = self.output(ref, y)
            for i in rows:
                e, one = law.output[i].e, law.numbers[OFFSET + i]
                missing = (wanted[i] << (e - US[i].q)) - self.raw[i]
                self.offset[i] = between(rounded(missing, e - one.q), one)
        return out[U : U + NU]


def bump_of(before: Sequence[int], after: Sequence[int]) -> int:
    """The largest change of u, times 2^BUMP_Q."""
    return max(abs(b - a) >> (one.q - BUMP_Q) for a, b, one in zip(before, after, US, strict=True))


def refusal(ref: Sequence[int], y: Sequence[int], bad_ref: int) -> int:
    """OK, or why a step refuses references and measurements."""
    if any(not one.low <= value <= one.high for value, one in zip(y, YS, strict=True)):
        return BAD_Y
    if any(not one.low <= value <= one.high for value, one in zip(ref, REFS, strict=True)):
        return bad_ref
    return OK


def to_integers(values: Any, numbers: Sequence[Number]) -> NDArray[np.int64]:
    """Values (ticks, k) in p.u. as integers; NaN and what an int32 does not hold saturates."""
    scaled = np.asarray(values, np.float64) * np.exp2([one.q for one in numbers])
    return np.rint(np.clip(np.nan_to_num(scaled, nan=-np.inf), -WORD - 1, WORD)).astype(np.int64)
