"""A law in fixed point: its word lengths and scalings, its tick, and its distance from float64.

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
``FixedLaw`` has the numbers. The tick is functions of integers: ``Instance`` runs them on Python's
own, which have no limit, and is the exact reference; the translator writes C from them. There ``v``
is the list of a tick's numbers by place (``REF``, ...); in C each is a member of the instance or of
the tick. ``deviations`` has proven bounds of how far u gets from the law in float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE, LINEAR, V_MIN
from gfm_runtime.errors import LawError
from gfm_runtime.signals import NU, NY, U_NAMES, group
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
        p, V, ratio = self.numbers[of + j], self.numbers[of + 4], self.numbers[out + j]
        most = math.ceil(math.ldexp(V.span[1] * G_MOST, QUOTIENT))
        first, second = 1 << (QUOTIENT + V.q - p.q), 1 << (V.q + ratio.q - QUOTIENT)
        return Ratio(round(math.ldexp(V_MIN, V.q)), first, most, second)


def number(text: str, low: float, high: float) -> Number:
    """The finest int32 that holds a range, p.u."""
    most = max(abs(low), abs(high), 2.0**-30)
    q = 30 - math.frexp(most)[1]
    q += int(math.ldexp(most, q + 1) <= WORD)
    return Number(text, q, math.ceil(math.ldexp(low, q)), math.floor(math.ldexp(high, q)))


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
REFS = tuple(number(f"t->ref[{j}]", s.low, s.high) for j, s in enumerate(group("ref")))
YS = tuple(number(f"t->y[{j}]", s.low, s.high) for j, s in enumerate(group("y")))
US = tuple(number(f"t->u[{i}]", s.low, s.high) for i, s in enumerate(group("u")))
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

    Beyond M powers |A^(Mp+m)| <= |A^m| |A^M|^p bounds the rest. Raises ValueError: the powers do
    not die away.
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
    1/2 and a rest of at most half as much. Raises ValueError: the powers of A do not die away.

    Returns:
        A about the middle; bounds of the sum and of the supremum of |A^m|; and the gain of the loop
        through the rest, below 1 if the bound exists.
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


def _mapped_numbers() -> dict[int, dict[int, Number]]:
    """By error map, the numbers of the columns that it changes."""
    (low, high), most_y = REFS[0].span, YS[0].span[1]
    energies = {
        R: number("t->r[0]", low * low / 2, high * high / 2),
        M: number("t->m[0]", 0.0, most_y * most_y / 2),
    }
    ratios = {
        place + j: number(f"t->{name}[{j}]", -G_MOST, G_MOST)
        for place, name in ((R, "r"), (M, "m"))
        for j in (1, 3)
    }
    sine = {R + 1: number("t->r[1]", -1.0, 1.0)}
    return {LINEAR: {}, DC_ENERGY: energies, DVOC: ratios, HYBRID_ANGLE: sine}


_MAPPED = _mapped_numbers()


class Ratio(NamedTuple):
    """What p/V^2 is computed with: the least V, the factors before the two divisions, and where the
    first quotient saturates, so that the second numerator fits."""

    least: int
    first: int
    most: int
    second: int


class Across(NamedTuple):
    """The integers R and X (p.u.) that p and q are multiplied with, at the exponent of V^2."""

    R: int
    X: int


ONE = 1 << 30  # of sines and cosines


# --- a law ---


def _row_of(values: Matrix, place: int, leave: int = -1) -> dict[int, float]:
    return {place + j: float(v) for j, v in enumerate(values) if j != leave and v != 0.0}


def _merge(*parts: Mapping[int, float]) -> dict[int, float]:
    out: dict[int, float] = {}
    for part in parts:
        for place, c in part.items():
            out[place] = out.get(place, 0.0) + c
    return out


def make_fixed(name: str, record: np.void) -> FixedLaw:
    """A law in fixed point. Raises LawError: what fixed point does not cover, or ranges that it
    cannot hold.

    Args:
        name: for messages.
        record: as ``gfm_runtime.kernel.pack_law`` gives it in float64.
    """
    where = f"law {name!r} in fixed point"
    law = _Builder(where, record).law()
    groups = ((law.output, U), (law.output, EXCESS), (law.output, OFFSET), (law.state, X),
              (law.decay, OFFSET), (law.follow, TREND), (law.settle, X), (law.last, U))  # fmt: skip
    for sums, place in groups:
        for k, total in enumerate(sums):
            if not 1 <= law.shift(total, place + k) <= MOST_SHIFT:
                text = law.numbers[place + k].text
                raise LawError(where, f"{text} has a range that no exponent fits")
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
        if (mapped := _MAPPED.get(self.error_map)) is None:
            raise LawError(self.where, "its error map is not covered")
        self.r, self.m = (R, M) if mapped else (REF, Y)
        if mapped:
            self.numbers |= {R + j: one for j, one in enumerate(REFS)}
            self.numbers |= {M + j: one for j, one in enumerate(YS)} | mapped
        self.across: tuple[Across, ...] = ()
        if self.error_map != HYBRID_ANGLE:
            return
        self.across = tuple(
            Across(*(round(math.ldexp(float(one), 2 * V.q - p.q)) for one in impedance))
            for _, p, _, _, V in (REFS, YS)
        )
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
        on_d = _merge(
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
        on_raw = _merge({OFFSET + i: 1.0}, on_x, on_d)
        total = make_sum(on_raw, self.seen, start, beside=most(US[i].span))
        raw, (low, high) = span_of(on_raw, self.seen, start), self.limited[U + i].span
        self.numbers[EXCESS + i] = number(
            f"t->excess[{i}]", min(0.0, high - raw[1]), max(0.0, low - raw[0])
        )
        return total

    def _state_numbers(self, i: int, own: Sequence[int], row: ClampedRow, d: Span) -> None:
        """The numbers of the states of row i; d is what the inputs add to its output."""
        forced = [span_of(self._input_terms(k), self.seen) for k in own]
        first = [span_of(*self._settling(k)) for k in own]
        for k, span in zip(own, _ranges(row, d, forced, first, self.f, i), strict=True):
            if span is None:
                raise LawError(
                    self.where,
                    f"the row of {U_NAMES[i]} has an integrator beside other states, or none that "
                    "the anti-windup holds: its states have no bound that is proven",
                )
            self.numbers[X + k] = number(f"s->x[{k}]", *span)

    def _input_terms(self, k: int) -> dict[int, float]:
        """What the inputs add to the next x_k."""
        f = self.f
        return _merge(
            _row_of(f["B_r"][k], self.r),
            _row_of(f["B_y"][k], self.m, OMEGA),
            {U + OMEGA - 1: float(f["B_y"][k, OMEGA])},
        )

    def _state(self, k: int) -> Sum:
        """The increment of x_k."""
        pull = float((self.A @ self.f["W"][: self.n])[k, int(self.rows[k])])
        own = {X + j: float(self.A[k, j] - (j == k)) for j in range(self.n)}
        meant = _merge(own, {EXCESS + int(self.rows[k]): pull}, self._input_terms(k))
        return make_sum(meant, self.seen, most_e=self.numbers[X + k].q + MOST_SHIFT)

    def _settling(self, k: int) -> tuple[dict[int, float], Mapping[int, Number], float]:
        """The arguments of the sum that sets x_k at a bumpless change."""
        f, F = self.f, self.f["F"][k]
        meant = _merge(
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


# --- what a processor does with integers; the template has these in C ---


def rounded(value, shift):
    """value 2^-shift, rounded to the nearest, halves up."""
    return (value + (1 << shift >> 1)) >> shift


def between(value, low, high):
    """The value, or the end of its range that it passes."""
    return min(max(value, low), high)


def divided(a, b):
    """a/b towards 0, as C divides; b > 0."""
    return a // b if a >= 0 else -(-a // b)


def root(square):
    """The integer below the square root of a number below 2^62."""
    return math.isqrt(square)


def wide(value):
    """A number of 64 bits in C."""
    return value


# --- error maps ---


def half_square(value, shift):
    """Half the square: column 1 of the error map."""
    return rounded(value * value, shift)


def over_square(p, V, least, first, most, second, high):
    """p/V^2, saturated: columns 2 and 4 of the error map. A dead bus must not divide by zero."""
    v, low = max(V, least), -most
    quotient = divided(p * first, v)
    quotient = max(quotient, low)
    quotient = min(quotient, most)
    return between(divided(quotient * second, v), -high, high)


def direction(x, y, out):
    """The direction of a vector: up to 2^30, the larger at least 2^29; or 0, 0."""
    p, q = x, y
    for bits in (32, 16, 8, 4, 2, 1):
        most = 1 << (62 - bits)
        if p > -most and p < most and q > -most and q < most:
            p *= 1 << bits
            q *= 1 << bits
    out[0] = p >> 32
    out[1] = q >> 32


def sine_of_half(x_a, y_a, x_b, y_b, a, b, turn):
    """sin((a - b)/2) 2^30 for the angles a and b of two vectors; 0 if one has no length."""
    direction(x_a, y_a, a)
    direction(x_b, y_b, b)
    if (a[0] == 0 and a[1] == 0) or (b[0] == 0 and b[1] == 0):
        return 0
    dot = a[0] * b[0] + a[1] * b[1]
    cross = a[1] * b[0] - a[0] * b[1]
    direction(dot, cross, turn)
    d = -turn[0] if turn[0] < 0 else turn[0]
    c = -turn[1] if turn[1] < 0 else turn[1]
    length = root(d * d + c * c)
    if length < ONE // 2:
        length = wide(ONE // 2)
    cosine = divided(d * ONE, length)
    if cosine > ONE:
        cosine = wide(ONE)
    larger = root((ONE + cosine) * (ONE // 2))
    if larger < ONE // 2:
        larger = wide(ONE // 2)
    sine = larger
    if dot >= 0:
        sine = divided(c * ONE, length)
        if sine > ONE:
            sine = wide(ONE)
        sine = divided(sine * (ONE // 2), larger)
    a_below, b_below = y_a < 0, y_b < 0
    if cross < 0 if a_below == b_below else a_below:
        sine = -sine
    return between(sine, -ONE, ONE)


def set_inputs(law, v, w):
    """What the error map makes of the references and measurements."""
    if law.error_map == DC_ENERGY:
        for out, of in ((R, REF), (M, Y)):
            v[out] = half_square(v[of], 2 * law.numbers[of].q + 1 - law.numbers[out].q)
    elif law.error_map == DVOC:
        for out, of in ((R, REF), (M, Y)):
            for j in (1, 3):
                ratio, high = law.ratio(of, out, j), law.numbers[out + j].high
                v[out + j] = over_square(
                    v[of + j], v[of + 4], ratio.least, wide(ratio.first), wide(ratio.most),
                    wide(ratio.second), high,
                )  # fmt: skip
    elif law.error_map == HYBRID_ANGLE:
        line = law.across[0]
        x_a = v[REF + 4] * v[REF + 4] - (line.R * v[REF + 1] + line.X * v[REF + 3])
        y_a = line.X * v[REF + 1] - line.R * v[REF + 3]
        line = law.across[1]
        x_b = v[Y + 4] * v[Y + 4] - (line.R * v[Y + 1] + line.X * v[Y + 3])
        y_b = line.X * v[Y + 1] - line.R * v[Y + 3]
        v[R + 1] = sine_of_half(x_a, y_a, x_b, y_b, w.a, w.b, w.turn)


# --- the tick ---


def sum_of(total, v):
    """A sum of products."""
    a = total.start
    for coefficient, place in total.terms:
        a += coefficient * v[place]
    return a


def output(law, v, w):
    """u before and after its limits, and what the limits add to it, for the anti-windup; omega_u
    comes first, since column 3 feeds it back."""
    for i in (1, 0, 2):
        total, shift = law.output[i], law.shift(law.output[i], U + i)
        low, high = law.low[i] << shift, law.high[i] << shift
        w.raw[i] = sum_of(total, v)
        if w.raw[i] > high:
            v[U + i] = law.high[i]
            v[EXCESS + i] = rounded(high - w.raw[i], law.shift(total, EXCESS + i))
        elif w.raw[i] < low:
            v[U + i] = law.low[i]
            v[EXCESS + i] = rounded(low - w.raw[i], law.shift(total, EXCESS + i))
        else:
            v[U + i] = rounded(w.raw[i], shift)
            v[EXCESS + i] = 0


def advance(law, v, w):
    """The offset, the trend and x of the next tick: the upper bits of each increment now, the
    others in later ticks."""
    for k in range(len(law.moving)):
        total, place = law.moving[k]
        one, shift = law.numbers[place], law.shift(total, place)
        if place < OFFSET or place >= X or v[place] != 0:  # an offset of 0 does not move
            now = w.rest[k] + sum_of(total, v)
            w.rest[k] = now & ((1 << shift) - 1)
            if place < X:
                v[place] = between(v[place] + (now >> shift), one.low, one.high)
            else:
                w.x_next[place - X] = between(v[place] + (now >> shift), one.low, one.high)
    for k in range(law.n):
        v[X + k] = w.x_next[k]
    for i in range(NU):
        v[LAST + i] = v[U + i]


def look(law, v, w, u):
    """u without a step."""
    set_inputs(law, v, w)
    output(law, v, w)
    for i in range(NU):
        u[i] = v[U + i]


def begin_rests(law, w):
    """A rest begins in the middle of what it can be."""
    for k in range(len(law.moving)):
        total, place = law.moving[k]
        w.rest[k] = 1 << (law.shift(total, place) - 1)


def settle(law, v, w, u, trend):
    """The state with which u comes out and goes on with the trend; on return what comes out."""
    for i in range(NU):
        of_u, of_trend, total = law.numbers[LAST + i], law.numbers[TREND + i], law.last[i]
        v[OFFSET + i] = 0
        v[U + i] = between(u[i], of_u.low, of_u.high)
        v[TREND + i] = between(trend[i], of_trend.low, of_trend.high)
        before = rounded(sum_of(total, v), law.shift(total, U + i))
        v[LAST + i] = between(before, of_u.low, of_u.high)
    begin_rests(law, w)
    set_inputs(law, v, w)
    for k in range(law.n):
        of_x, total = law.numbers[X + k], law.settle[k]
        x = rounded(sum_of(total, v), law.shift(total, X + k))
        v[X + k] = between(x, of_x.low, of_x.high)
    # the offset takes the rest: all of it in a row without states, rounding in the others
    for rows in ((1,), (0, 2), ()):
        output(law, v, w)
        for i in rows:
            of_u, of_offset, e = law.numbers[LAST + i], law.numbers[OFFSET + i], law.output[i].e
            wanted = between(u[i], of_u.low, of_u.high)
            missing = rounded(wanted * (1 << (e - of_u.q)) - w.raw[i], e - of_offset.q)
            v[OFFSET + i] = between(missing, of_offset.low, of_offset.high)
    for i in range(NU):
        u[i] = v[U + i]


def bump_of(before, after):
    """The largest change of u, times 2^BUMP_Q."""
    most = wide(0)
    for i in range(NU):
        change = wide(after[i]) - before[i]
        if change < 0:
            change = -change
        change = change >> (US[i].q - BUMP_Q)
        if change > most:
            most = change
    return between(most, 0, WORD)


# --- in Python ---


class Instance:
    """An instance of a law in Python's integers, as the C code has it."""

    def __init__(self, law: FixedLaw) -> None:
        self.law, self._v = law, [0] * (X + law.n)
        self._v[LAST : LAST + NU] = U_DEFAULT
        pairs = {name: [0, 0] for name in ("a", "b", "turn")}
        self._w = SimpleNamespace(
            raw=[0] * NU, rest=[0] * len(law.moving), x_next=[0] * law.n, **pairs
        )
        self.reset()

    def reset(self) -> None:
        """States 0; the last u stays."""
        self._v[TREND:] = [0] * (len(self._v) - TREND)
        begin_rests(self.law, self._w)

    def __getattr__(self, name: str) -> list[int]:
        """x, offset, u of the last tick and trend; and rest, what the increments left below the
        offset, the trend and x."""
        if name == "rest":
            return list(self._w.rest)
        start = {"x": X, "offset": OFFSET, "u": LAST, "trend": TREND}[name]
        return self._v[start : None if name == "x" else start + NU]

    def _set(self, ref: Sequence[int], y: Sequence[int]) -> None:
        self._v[:U] = [*ref, *y, *ref, *y]

    def look(self, ref: Sequence[int], y: Sequence[int]) -> list[int]:
        """u without a step."""
        u = [0] * NU
        self._set(ref, y)
        look(self.law, self._v, self._w, u)
        return u

    def step(self, ref: Sequence[int], y: Sequence[int]) -> list[int]:
        """One tick; u."""
        u = self.look(ref, y)
        advance(self.law, self._v, self._w)
        return u

    def settle(
        self, ref: Sequence[int], y: Sequence[int], u: Sequence[int], trend: Sequence[int]
    ) -> list[int]:
        """Set the state so that u comes out and goes on with the trend; what comes out."""
        out = list(u)
        self._set(ref, y)
        settle(self.law, self._v, self._w, out, trend)
        return out


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


# --- how far a law in fixed point, or in float32, gets from the same law in float64 ---
#
# Both get the same inputs, and after a bumpless change both start from the same u and trend. Let d
# be the difference of the states of one row, r how far a rest is from its middle (half a unit of
# the state at most), and e what the rounding of coefficients and signals adds in one tick at most:
#
#     d' = A d + (I - A) r + A W (difference of the excess) + e,
#     difference of raw = c (d - r) + e_raw,
#
# and the clamp passes a difference of raw on to u with a factor 1 - theta, and to the excess with
# -theta, 0 <= theta <= 1, whatever the inputs do. ``sector`` turns that into a loop whose l1 norm
# bounds d for ever. The state of an integrator has no such bound in open loop, in any precision:
# its difference grows by no more than e a tick, and shrinks only while its row is limited. That is
# the ``drift``. In float32, e follows from the standard model of rounding with m = n + 12,
# gamma = m u/(1 - m u), u = 2^-24 (N. J. Higham, "Accuracy and Stability of Numerical Algorithms",
# section 3.1).

NEAR = 0.05  # p.u. from the default inputs: what is called small
_ON_CIRCLE = 1e-9


class Deviation(NamedTuple):
    """Of one output from its value in float64."""

    bound: float  #: p.u., for ever if the drift is 0
    #: p.u. a tick at most, to be added for each tick since the start or the last settle.
    drift: float

    def after(self, ticks: float) -> float:
        """The bound after that many ticks."""
        return self.bound + self.drift * ticks


class Local(NamedTuple):
    """What one row adds in a tick, or at a settle, at most: errors of raw and of u, p.u.; of the
    increments of its states; of its states at a settle; half a unit of its states; and of the
    offset's size and course."""

    raw: float
    u: float
    excess: float
    offset: float
    x: Matrix
    first: Matrix
    q: Matrix


def deviations(law: FixedLaw, record: np.void, real: str, near: bool = False) -> list[Deviation]:
    """Of (i_u, omega_u, E_u).

    Args:
        law: in fixed point; its ranges are used for float32 too.
        record: the law in float64.
        real: ``fixed``, or float32 or float64, whose own distance from exact arithmetic is given.
        near: for inputs within ``NEAR`` of the defaults and u within its limits.
    """
    rounding = _Rounding(law, real, near)
    rows, A = record["row"][: law.n], np.asarray(record["A"][: law.n, : law.n], np.float64)
    out: dict[int, Deviation] = {}
    for i in (OMEGA - 1, 0, 2):
        own = [int(k) for k in np.flatnonzero(rows == i)]
        gain = float(record["loop"]) if i == OMEGA - 1 else 1.0
        c, W = gain * record["C"][i, own].astype(float), record["W"][own, i].astype(float)
        row = ClampedRow(A[np.ix_(own, own)], c, W)
        b = record["B_y"][own, OMEGA].astype(float)
        local, feedback = rounding.of_row(i, own), b
        if i != OMEGA - 1:  # omega_u, which has its own deviation, is an input of this row
            omega, feedback = out[OMEGA - 1], np.zeros(len(own))
            at_once = abs(float(record["D_y"][i, OMEGA]))
            if at_once or b.any():
                if omega.drift or math.isinf(omega.bound):
                    out[i] = Deviation(math.inf, math.inf)
                    continue
                local = local._replace(
                    raw=local.raw + at_once * omega.bound, x=local.x + np.abs(b) * omega.bound
                )
        out[i] = _row(row, feedback, local, clamped=not near)
    return [out[i] for i in range(NU)]


def _row(row: ClampedRow, feedback: Matrix, local: Local, clamped: bool) -> Deviation:
    """From what a tick adds to what it makes of the row's u; ``clamped`` if the limits may act."""
    c = np.abs(row.c)
    at_once = local.raw + float(c @ local.q)
    at_once += local.offset + float(c @ local.first) + at_once  # the offset takes that of a settle
    if not len(c):
        return Deviation(at_once + local.u, 0.0)
    pull = row.A @ row.W * clamped
    to_excess = at_once + local.excess * clamped
    each = local.x + np.abs(np.eye(len(c)) - row.A) @ local.q + np.abs(feedback) * local.u
    try:
        if clamped:
            _, total, peak, gain = sector(row, feedback)
            each += np.abs(pull - feedback) / 2 * to_excess
        else:
            total, peak = powers(row.A + np.outer(feedback, row.c))
            each += np.abs(feedback) * at_once
            gain = 0.0
    except ValueError:
        gain = 1.0
    if gain < 1 - 1e-6:
        raw = float(c @ (peak @ local.first + total @ each)) + to_excess
        return Deviation(raw / (1 - gain) + local.u, 0.0)
    if len(c) > 1 or abs(row.A[0, 0] - 1) > _ON_CIRCLE or feedback.any():
        return Deviation(math.inf, math.inf)
    # at a limit the state of an integrator takes over what raw has; else it keeps what it had
    state = max(float(local.first[0]), to_excess / float(c[0]) * clamped)
    return Deviation(float(c[0]) * state + at_once + local.u, float(c[0] * local.x[0]))


def _spans(law: FixedLaw, near: bool) -> dict[int, Span]:
    """The ranges of a tick's numbers, p.u."""
    spans = {place: one.span for place, one in enumerate(law.numbers) if one.text}
    for i in range(NU):
        q = law.numbers[U + i].q
        spans[U + i] = math.ldexp(law.low[i], -q), math.ldexp(law.high[i], -q)
    if near:
        for place, mapped, signals in ((REF, R, group("ref")), (Y, M, group("y"))):
            for j, s in enumerate(signals):
                spans[place + j] = s.default - NEAR, s.default + NEAR
                if law.numbers[mapped + j].text == law.numbers[place + j].text:
                    spans[mapped + j] = spans[place + j]
                elif law.error_map == DC_ENERGY:
                    spans[mapped + j] = (1 - NEAR) ** 2 / 2, (1 + NEAR) ** 2 / 2
                elif law.error_map == DVOC:
                    ratio = (abs(s.default) + NEAR) / (1 - NEAR) ** 2
                    spans[mapped + j] = -ratio, ratio
        spans |= {EXCESS + i: (0.0, 0.0) for i in range(NU)}
    return spans


def _of_angle(law: FixedLaw) -> float:
    """Of sin((delta_ref - delta)/2) near the default inputs: half of what turns the two vectors and
    their product, and four roundings."""
    turned = 3 * math.sqrt(2) * 2.0**-29
    for of, many in zip(law.across, (REFS, YS), strict=True):
        exponent = 2 * many[4].q - many[1].q
        power = max(abs(s.default) for s in group("ref")[1:4:2]) + NEAR
        length = (1 - NEAR) ** 2 - math.ldexp(abs(of.R) + abs(of.X), -exponent) * power
        turned += 2 * power * 2.0 ** (-1 - exponent) * math.sqrt(2) / length
    return turned / 2 + 4 * 2.0**-30


class _Rounding:
    """What rounding adds in a tick at most, in fixed point or in a floating-point precision."""

    def __init__(self, law: FixedLaw, real: str, near: bool) -> None:
        self.law, self.fixed = law, real == FIXED
        self.unit = 2.0 ** (-24 if real == "float32" else -53)  # of a floating-point precision
        self.spans, self.maps = _spans(law, near), self._of_map(near)

    def of_row(self, i: int, own: Sequence[int]) -> Local:
        """Of row i, whose states are ``own``."""
        law, fade = self.law, -self.law.decay[i].meant[OFFSET + i]
        if self.fixed:
            units = [math.ldexp(1.0, -one.q) for one in law.numbers]
            settled = {**self.spans, **{U + j: law.numbers[U + j].span for j in range(NU)}}
            halves = np.array([units[X + k] / 2 for k in own])
            return Local(
                raw=self._error(law.output[i]) + math.ldexp(1.0, -law.output[i].e),
                u=units[U + i],
                excess=units[EXCESS + i],
                offset=self._error(law.decay[i]) / fade + 1.5 * units[OFFSET + i],
                x=np.array([self._error(law.state[k]) for k in own]),
                first=np.array([self._error(law.settle[k], settled) for k in own]) + halves,
                q=halves,
            )
        m = law.n + 12
        gamma = m * self.unit / (1 - m * self.unit)

        def size(total: Sum, more: float = 0.0) -> float:
            terms = sum(abs(c) * most(self.spans[place]) for place, c in total.meant.items())
            return gamma * (terms + abs(total.meant_start) + more) + self._through(total)

        u, raw = self.unit * most(self.spans[U + i]), size(law.output[i])
        return Local(
            raw=raw,
            u=u,
            excess=raw + u,
            offset=gamma * most(self.spans[OFFSET + i]) / fade + raw,
            x=np.array([size(law.state[k], 2 * most(self.spans[X + k])) for k in own]),
            first=np.array([size(law.settle[k]) for k in own]),
            q=np.zeros(len(own)),
        )

    def _error(self, total: Sum, spans: Mapping[int, Span] | None = None) -> float:
        """What the rounding of a sum's coefficients and of the error map adds to it, p.u."""
        has = {place: coefficient for coefficient, place in total.terms}
        low = high = math.ldexp(total.start, -total.e) - total.meant_start
        for place, meant in total.meant.items():
            error = math.ldexp(has.get(place, 0), self.law.numbers[place].q - total.e) - meant
            ends = [error * end for end in (spans or self.spans)[place]]
            low, high = low + min(ends), high + max(ends)
        return most((low, high)) + self._through(total)

    def _through(self, total: Sum) -> float:
        """What the errors of an error map become in a sum."""
        return sum(abs(c) * self.maps.get(place, 0.0) for place, c in total.meant.items())

    def _of_map(self, near: bool) -> dict[int, float]:
        """By place, the error of what an error map gives: in fixed point of its roundings; in
        floating point 8 roundings at most."""
        law, numbers = self.law, self.law.numbers
        if law.error_map == LINEAR:
            return {}
        places = [p for p in range(R, M + 5) if numbers[p].text.startswith(("t->r[", "t->m["))]
        units = {p: math.ldexp(1.0, -numbers[p].q) for p in places}
        if law.error_map == HYBRID_ANGLE and not near:  # at a vector without length the map jumps
            return {R + 1: math.inf}
        if not self.fixed:
            return {p: 8 * self.unit * most(numbers[p].span) for p in places}
        if law.error_map == DC_ENERGY:
            return {p: unit / 2 for p, unit in units.items()}
        if law.error_map == HYBRID_ANGLE:
            return {R + 1: _of_angle(law)}
        V = 1 - NEAR if near else V_MIN
        first = math.ldexp(1.0, -QUOTIENT) / V
        # the least V is an integer, and p/V^2 has twice its relative error
        least = 0.0 if near else G_MOST * 2 * math.ldexp(1.0, -1 - min(YS[4].q, REFS[4].q)) / V_MIN
        return {p: unit + first + 1.01 * least for p, unit in units.items()}
