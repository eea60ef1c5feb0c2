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
``FixedLaw`` has the numbers; ``fixed_tick`` has the tick, for Python and for C; ``deviation`` has
the bounds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE, LINEAR, V_MIN
from gfm_runtime.errors import LawError
from gfm_runtime.signals import NU, NY, U_NAMES, Signal, group

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
    """An int32 of the C code."""

    text: str  #: in C
    q: int  #: its value is the integer times 2^-q, in p.u.
    #: low, high: the integers between which it stays
    low: int
    high: int

    @property
    def span(self) -> Span:
        """Its range in p.u."""
        return math.ldexp(self.low, -self.q), math.ldexp(self.high, -self.q)


class Sum(NamedTuple):
    """A sum of products at one exponent."""

    e: int  #: its value is the integer times 2^-e
    start: int  #: the constant
    terms: tuple[tuple[int, int], ...]  #: coefficient and place of each number; none is 0
    #: the coefficients in real numbers by place, those that round to 0 too
    meant: Mapping[int, float]
    meant_start: float  #: the constant in real numbers


@dataclass(frozen=True)
class FixedLaw:
    """A law's numbers and sums."""

    n: int  #: states
    #: of a tick, by place (REF, Y, ...); a place without a number has None
    numbers: tuple[Number, ...]
    #: low, high: limits of u, as integers of u
    low: tuple[int, ...]
    high: tuple[int, ...]
    output: tuple[Sum, ...]  #: u before its limits, at each row's exponent
    state: tuple[Sum, ...]  #: increments of x
    #: decay, follow: increments of the offset and of the trend
    decay: tuple[Sum, ...]
    follow: tuple[Sum, ...]
    settle: tuple[Sum, ...]  #: x at a bumpless change
    last: tuple[Sum, ...]  #: u of the tick before a bumpless change
    error_map: int  #: its code
    across: tuple[Across, ...] = ()  #: of hybrid-angle, for the references and for the measurements

    def shift(self, total: Sum, place: int) -> int:
        """Bits from a sum to the number at a place."""
        return total.e - self.numbers[place].q

    @cached_property
    def moving(self) -> list[tuple[Sum, int]]:
        """Of all that moves from tick to tick: its increment and its place."""
        return [
            *((total, OFFSET + i) for i, total in enumerate(self.decay)),
            *((total, TREND + i) for i, total in enumerate(self.follow)),
            *((total, X + k) for k, total in enumerate(self.state)),
        ]

    def ratio(self, of: int, out: int, j: int) -> Ratio:
        """What p/V^2 is computed with, from the numbers at ``of`` to that at ``out + j``."""
        return ratio_of(self.numbers[of + j], self.numbers[of + 4], self.numbers[out + j])


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


class ClampedRow(NamedTuple):
    """The states of one row: x' = A (x + W excess) + ..., raw = c x + ..."""

    A: Matrix
    c: Matrix
    W: Matrix


def _one_state(row: ClampedRow, d: Span, forced: Span, low: float, high: float) -> Span | None:
    """The interval that one state cannot leave from within: d and ``forced`` are what the inputs
    add to raw and to the next x. None if it has no such interval."""
    a, c, w = float(row.A[0, 0]), float(row.c[0]), float(row.W[0])
    a = 1.0 if abs(a - 1.0) < 1e-12 else a
    if not (0 < a <= 1 and c > 0 and 0 <= w * c <= 1 and (a < 1 or w > 0)):
        return None

    def upper(high: float, d_low: float, forced: float) -> float:
        if a < 1 and c * forced / (1 - a) + d_low <= high:
            return forced / (1 - a)
        return (a * w * (high - d_low) + forced) / (1 - a * (1 - w * c))

    return -upper(-low, -d[1], -forced[0]), upper(high, d[0], forced[1])


def sector(row: ClampedRow, feedback: Matrix | float = 0.0) -> tuple[Matrix, Matrix, Matrix, float]:
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
    A, c, W = row
    pull = A @ W
    middle = A - np.outer(pull - feedback, c) / 2
    total, peak = powers(middle)
    gain = 0.0
    if len(A) == 1:
        gain = float(np.abs(c) @ total @ np.abs(pull + feedback)) / 2
    else:
        along, h = c, (pull + feedback) / 2
        for _ in range(200_000):
            gain += abs(float(along @ h))
            along = along @ middle
            if float(np.abs(along) @ total @ np.abs(h)) < 1e-6:
                break
        gain += float(np.abs(along) @ total @ np.abs(h))
    return middle, total, peak, gain


def _many_states(
    row: ClampedRow, d: Span, forced: Matrix, first: Matrix, low: float, high: float
) -> Matrix | None:
    """The largest |x| of a row's states from |x| <= ``first`` on, whatever its clamp does."""
    try:
        _, total, peak, gain = sector(row)
    except ValueError:
        return None
    if gain >= 1 - 1e-6:
        return None
    c, pull = np.abs(row.c), np.abs(row.A @ row.W)
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
    """What p/V^2 is computed with: the least V, the factors before the two divisions, and where the
    first quotient saturates, so that the second numerator fits."""

    least: int
    first: int
    most: int
    second: int


def ratio_of(p: Number, V: Number, out: Number) -> Ratio:
    """Of the numbers p and V, for the number p/V^2."""
    most = math.ceil(math.ldexp(V.span[1] * G_MOST, QUOTIENT))
    first, second = 1 << (QUOTIENT + V.q - p.q), 1 << (V.q + out.q - QUOTIENT)
    return Ratio(round(math.ldexp(V_MIN, V.q)), first, most, second)


class Across(NamedTuple):
    """The integers R and X (p.u.) that p and q are multiplied with, at the exponent of V^2."""

    R: int
    X: int


def across(parameters: Matrix, p: Number, V: Number) -> Across:
    """For the numbers p (and q) and V."""
    return Across(*(round(math.ldexp(float(one), 2 * V.q - p.q)) for one in parameters))


ONE = 1 << 30  # of sines and cosines


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
    law = _Builder(f"law {name!r} in fixed point", record).law()
    _check(f"law {name!r} in fixed point", law)
    return law


class _Builder:
    """A law's numbers, one group after the other: each range follows from those before it.

    Attributes:
        numbers: those that are known, by place.
        seen: the same as the sums of a step see them: u within the law's limits.
    """

    def __init__(self, where: str, record: np.void) -> None:
        self.where, self.error_map, self.n = where, int(record["error_map"]), int(record["n"])
        self.f: dict[str, Matrix] = {
            key: np.asarray(record[key], np.float64)
            for key in ("B_r", "B_y", "C", "D_r", "D_y", "D_u0", "u_0", "low", "high", "W", "E_r",
                        "E_y", "F", "G")
        }  # fmt: skip
        self.A = np.asarray(record["A"][: self.n, : self.n], np.float64)
        self.rows, self.loop = record["row"][: self.n], float(record["loop"])
        self.fade, self.follow = 1.0 - float(record["decay"]), float(record["follow"])
        self.numbers: dict[int, Number] = {}
        for place, many in ((REF, REFS), (Y, YS), (U, US), (TREND, trends(self.follow))):
            self.numbers |= {place + k: one for k, one in enumerate(many)}
        self._map_inputs(record["error_parameters"])
        self.numbers |= {
            LAST + i: Number(f"s->u[{i}]", one.q, one.low, one.high) for i, one in enumerate(US)
        }
        ends = [self._limits(i) for i in range(NU)]
        self.low, self.high = (tuple(end[k] for end in ends) for k in range(2))
        self.limited = {U + i: Number(one.text, one.q, *ends[i]) for i, one in enumerate(US)}

    @property
    def seen(self) -> dict[int, Number]:
        return self.numbers | self.limited

    def law(self) -> FixedLaw:
        """All of it."""
        outputs = tuple(self._row(i) for i in range(NU))
        numbers = self.numbers
        moves = [({OFFSET + i: -self.fade}, OFFSET + i) for i in range(NU)] + [
            ({TREND + i: -self.follow, U + i: self.follow, LAST + i: -self.follow}, TREND + i)
            for i in range(NU)
        ]
        decay_follow = tuple(
            make_sum(meant, numbers, most_e=numbers[place].q + MOST_SHIFT) for meant, place in moves
        )
        return FixedLaw(
            self.n,
            tuple(numbers.get(place, Number("", 0, 0, 0)) for place in range(X + self.n)),
            self.low,
            self.high,
            outputs,
            tuple(self._state(k) for k in range(self.n)),
            decay_follow[:NU],
            decay_follow[NU:],
            tuple(make_sum(*self._settling(k)) for k in range(self.n)),
            tuple(make_sum({U + i: 1.0, TREND + i: -1.0}, numbers) for i in range(NU)),
            self.error_map,
            self.across,
        )

    def _map_inputs(self, impedance: Matrix) -> None:
        """The numbers of the inputs after the error map; ``r`` and ``m`` are their places."""
        mapped = _mapped(self.error_map)
        if mapped is None:
            raise LawError(self.where, "its error map is not covered")
        self.r, self.m = (R, M) if mapped else (REF, Y)
        if mapped:
            self.numbers |= {R + j: one for j, one in enumerate(REFS)}
            self.numbers |= {M + j: one for j, one in enumerate(YS)} | mapped
        self.across: tuple[Across, ...] = ()
        if self.error_map != HYBRID_ANGLE:
            return
        self.across = tuple(across(impedance, many[1], many[4]) for many in (REFS, YS))
        for line, many in zip(self.across, (REFS, YS), strict=True):
            size = abs(line.R) + abs(line.X)
            if size > WORD or many[4].high ** 2 + size * many[1].high >= SUM:
                why = "R and X of its error map must be less than 1 p.u. in all"
                raise LawError(self.where, why)
        for key in ("B_y", "D_y", "E_y"):  # the map has the difference in r
            self.f[key] = self.f[key] * [1, 0, 1, 1, 1]

    def _limits(self, i: int) -> tuple[int, int]:
        """Of u_i, as integers."""
        one, low, high = US[i], self.f["low"][i], self.f["high"][i]
        if not one.span[0] - 1e-9 <= low < high <= one.span[1] + 1e-9:
            raise LawError(
                self.where,
                f"limits.{U_NAMES[i]} = [{low:g}, {high:g}] must lie in the signal table's range, "
                f"{one.span[0]:.3g} to {one.span[1]:.3g} p.u.",
            )
        return (
            max(one.low, math.ceil(math.ldexp(low, one.q))),
            min(one.high, math.floor(math.ldexp(high, one.q))),
        )

    def _row(self, i: int) -> Sum:
        """u_i before its limits; and the numbers of the row's offset, states and excess."""
        f, gain = self.f, self.loop if i == OMEGA - 1 else 1.0
        own = [int(k) for k in np.flatnonzero(self.rows == i)]
        on_d = _merged(
            _row_of(gain * f["D_u0"][i], REF),
            _row_of(gain * f["D_r"][i], self.r),
            _row_of(gain * f["D_y"][i], self.m, OMEGA),
            {U + OMEGA - 1: float(f["D_y"][i, OMEGA])} if i != OMEGA - 1 else {},
        )
        on_d = {place: c for place, c in on_d.items() if c != 0.0}
        start = gain * float(f["u_0"][i])
        d = span_of(on_d, self.seen, start)
        room = SMALL if own else most(d) + most(US[i].span)
        self.numbers[OFFSET + i] = number(f"s->offset[{i}]", -room, room)
        row = ClampedRow(self.A[np.ix_(own, own)], gain * f["C"][i, own], f["W"][own, i])
        self._state_numbers(i, own, row, (d[0] - room, d[1] + room))
        on_x = {X + k: float(gain * f["C"][i, k]) for k in own}
        on_raw = _merged({OFFSET + i: 1.0}, on_x, on_d)
        total = make_sum(on_raw, self.seen, start, beside=most(US[i].span))
        raw, (low, high) = span_of(on_raw, self.seen, start), self.limited[U + i].span
        self.numbers[EXCESS + i] = number(
            f"t->excess[{i}]", min(0.0, high - raw[1]), max(0.0, low - raw[0])
        )
        return total

    def _state_numbers(self, i: int, own: Sequence[int], row: ClampedRow, d: Span) -> None:
        """The numbers of the states of row i; d is what the inputs add to its output."""
        forced = [span_of(self._forced(k), self.seen) for k in own]
        first = [span_of(*self._settling(k)) for k in own]
        for k, span in zip(own, _ranges(row, d, forced, first, self.f, i), strict=True):
            if span is None:
                raise LawError(
                    self.where,
                    f"the row of {U_NAMES[i]} has an integrator beside other states, or none that "
                    "the anti-windup holds: its states have no bound that is proven",
                )
            self.numbers[X + k] = number(f"s->x[{k}]", *span)

    def _forced(self, k: int) -> dict[int, float]:
        """What the inputs add to the next x_k."""
        f = self.f
        return _merged(
            _row_of(f["B_r"][k], self.r),
            _row_of(f["B_y"][k], self.m, OMEGA),
            {U + OMEGA - 1: float(f["B_y"][k, OMEGA])},
        )

    def _state(self, k: int) -> Sum:
        """The increment of x_k."""
        pull = float((self.A @ self.f["W"][: self.n])[k, int(self.rows[k])])
        own = {X + j: float(self.A[k, j] - (j == k)) for j in range(self.n)}
        meant = _merged(own, {EXCESS + int(self.rows[k]): pull}, self._forced(k))
        return make_sum(meant, self.seen, most_e=self.numbers[X + k].q + MOST_SHIFT)

    def _settling(self, k: int) -> tuple[dict[int, float], Mapping[int, Number], float]:
        """The arguments of the sum that sets x_k at a bumpless change."""
        f, F = self.f, self.f["F"][k]
        meant = _merged(
            _row_of(f["E_r"][k], self.r),
            _row_of(f["E_y"][k], self.m, OMEGA),
            {U + OMEGA - 1: float(f["E_y"][k, OMEGA])},
            _row_of(F, U),
            _row_of(-F @ f["D_u0"], REF),
            _row_of(f["G"][k], TREND),
        )
        return meant, self.numbers, -float(F @ f["u_0"])


def _ranges(
    row: ClampedRow,
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
        kept = _one_state(row, d, forced[0], low, high)
        if kept is not None:
            return [(min(0.0, kept[0], first[0][0]), max(0.0, kept[1], first[0][1]))]
    sizes = _many_states(
        row, d, np.array(list(map(most, forced))), np.array(list(map(most, first))), low, high
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
