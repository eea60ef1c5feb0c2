"""The tick of a law in fixed point: functions of integers, for Python's own and for C.

``Instance`` runs them on Python's integers, which have no limit: it is the exact reference. The
translator writes C from the same functions. ``v`` is the list of a tick's numbers by place
(``fixed.REF``, ...); in C each is a member of the instance or of the tick.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE
from gfm_runtime.firmware.fixed import (
    BUMP_Q,
    EXCESS,
    LAST,
    OFFSET,
    ONE,
    REF,
    REFS,
    TREND,
    U_DEFAULT,
    US,
    WORD,
    YS,
    FixedLaw,
    M,
    Number,
    R,
    U,
    X,
    Y,
)
from gfm_runtime.signals import NU
from gfm_runtime.states import BAD_Y, OK

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
