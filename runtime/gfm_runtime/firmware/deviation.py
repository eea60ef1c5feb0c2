"""Proven bounds of how far a law in fixed point, or in float32, gets from the same law in float64.

Both get the same inputs, and after a bumpless change both start from the same u and trend. Let d be
the difference of the states of one row, r how far a rest is from its middle (half a unit of the
state at most), and e what the rounding of coefficients and signals adds in one tick at most. Then

    d' = A d + (I - A) r + A W (difference of the excess) + e,
    difference of raw = c (d - r) + e_raw,

and the clamp passes a difference of raw on to u with a factor 1 - theta, and to the excess with
-theta, 0 <= theta <= 1, whatever the inputs do. ``fixed.sector`` turns that into a loop whose l1
norm bounds d for ever. The state of an integrator has no such bound in open loop, in any precision:
its difference grows by no more than e a tick, and shrinks only while its row is limited. That is
the ``drift``. In float32, e follows from the standard model of rounding with gamma = m u/(1 - m u),
m = n + 12, u = 2^-24 (N. J. Higham, "Accuracy and Stability of Numerical Algorithms", section 3.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE, LINEAR, V_MIN
from gfm_runtime.firmware.fixed import (
    EXCESS,
    FIXED,
    G_MOST,
    OFFSET,
    OMEGA,
    QUOTIENT,
    REF,
    REFS,
    YS,
    ClampedRow,
    FixedLaw,
    M,
    Number,
    R,
    Span,
    Sum,
    U,
    X,
    Y,
    most,
    powers,
    sector,
)
from gfm_runtime.signals import NU, group

NEAR = 0.05  # p.u. from the default inputs: what is called small
_ON_CIRCLE = 1e-9

Vector = NDArray[np.float64]


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
    x: Vector
    first: Vector
    q: Vector


def deviations(law: FixedLaw, record: np.void, real: str, near: bool = False) -> list[Deviation]:
    """Of (i_u, omega_u, E_u).

    Args:
        law: in fixed point; its ranges are used for float32 too.
        record: the law in float64.
        real: ``fixed``, or float32 or float64, whose own distance from exact arithmetic is given.
        near: for inputs within ``NEAR`` of the defaults and u within its limits.
    """
    spans, maps = _spans(law, near), _of_map(law, real, near)
    rows, A = record["row"][: law.n], np.asarray(record["A"][: law.n, : law.n], np.float64)
    out: dict[int, Deviation] = {}
    for i in (OMEGA - 1, 0, 2):
        own = [int(k) for k in np.flatnonzero(rows == i)]
        gain = float(record["loop"]) if i == OMEGA - 1 else 1.0
        c, W = gain * record["C"][i, own].astype(float), record["W"][own, i].astype(float)
        row = ClampedRow(A[np.ix_(own, own)], c, W)
        b = record["B_y"][own, OMEGA].astype(float)
        local = (
            _in_fixed_point(law, i, own, spans, maps)
            if real == FIXED
            else _in_floating_point(law, i, own, spans, maps, _unit(real))
        )
        feedback = b
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


def _unit(real: str) -> float:
    """The unit roundoff of a floating-point precision."""
    return 2.0 ** (-24 if real == "float32" else -53)


def _row(row: ClampedRow, feedback: Vector, local: Local, clamped: bool) -> Deviation:
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


def _error(
    total: Sum,
    numbers: Sequence[Number],
    spans: Mapping[int, Span],
    maps: Mapping[int, float],
) -> float:
    """What the rounding of a sum's coefficients and of the error map adds to it at most, p.u."""
    has = {place: coefficient for coefficient, place in total.terms}
    low = high = math.ldexp(total.start, -total.e) - total.meant_start
    for place, meant in total.meant.items():
        error = math.ldexp(has.get(place, 0), numbers[place].q - total.e) - meant
        ends = [error * end for end in spans[place]]
        low, high = low + min(ends), high + max(ends)
    return most((low, high)) + _through(total, maps)


def _through(total: Sum, maps: Mapping[int, float]) -> float:
    """What the errors of an error map become in a sum."""
    return sum(abs(c) * maps.get(place, 0.0) for place, c in total.meant.items())


def _of_map(law: FixedLaw, real: str, near: bool) -> dict[int, float]:
    """By place, the error of what an error map gives: in fixed point of its roundings; in floating
    point 8 roundings at most."""
    if law.error_map == LINEAR:
        return {}
    places = [p for p in range(R, M + 5) if law.numbers[p].text.startswith(("t->r[", "t->m["))]
    units = {p: math.ldexp(1.0, -law.numbers[p].q) for p in places}
    if law.error_map == HYBRID_ANGLE and not near:  # at a vector without length the map jumps
        return {R + 1: math.inf}
    if real != FIXED:
        return {p: 8 * _unit(real) * most(law.numbers[p].span) for p in places}
    if law.error_map == DC_ENERGY:
        return {p: unit / 2 for p, unit in units.items()}
    if law.error_map == HYBRID_ANGLE:
        return {R + 1: _of_angle(law)}
    V = 1 - NEAR if near else V_MIN
    first = math.ldexp(1.0, -QUOTIENT) / V
    # the least V is an integer, and p/V^2 has twice its relative error
    least = 0.0 if near else G_MOST * 2 * math.ldexp(1.0, -1 - min(YS[4].q, REFS[4].q)) / V_MIN
    return {p: unit + first + 1.01 * least for p, unit in units.items()}


def _in_fixed_point(
    law: FixedLaw, i: int, own: Sequence[int], spans: Mapping[int, Span], maps: Mapping[int, float]
) -> Local:
    numbers = law.numbers

    def unit(place: int) -> float:
        return math.ldexp(1.0, -numbers[place].q)

    fade = -law.decay[i].meant[OFFSET + i]
    faded = _error(law.decay[i], numbers, spans, {}) / fade
    settled = {**spans, **{U + j: numbers[U + j].span for j in range(NU)}}
    return Local(
        raw=_error(law.output[i], numbers, spans, maps) + math.ldexp(1.0, -law.output[i].e),
        u=unit(U + i),
        excess=unit(EXCESS + i),
        offset=faded + 1.5 * unit(OFFSET + i),
        x=np.array([_error(law.state[k], numbers, spans, maps) for k in own]),
        first=np.array(
            [_error(law.settle[k], numbers, settled, maps) + unit(X + k) / 2 for k in own]
        ),
        q=np.array([unit(X + k) / 2 for k in own]),
    )


def _in_floating_point(
    law: FixedLaw,
    i: int,
    own: Sequence[int],
    spans: Mapping[int, Span],
    maps: Mapping[int, float],
    u: float,
) -> Local:
    m = law.n + 12
    gamma = m * u / (1 - m * u)

    def size(total: Sum, more: float = 0.0) -> float:
        return gamma * (
            sum(abs(c) * most(spans[place]) for place, c in total.meant.items())
            + abs(total.meant_start)
            + more
        ) + _through(total, maps)

    limit = most(spans[U + i])
    raw = size(law.output[i])
    offset = most(spans[OFFSET + i])
    fade = -law.decay[i].meant[OFFSET + i]
    return Local(
        raw=raw,
        u=u * limit,
        excess=raw + u * limit,
        offset=gamma * offset / fade + raw,
        x=np.array([size(law.state[k], 2 * most(spans[X + k])) for k in own]),
        first=np.array([size(law.settle[k]) for k in own]),
        q=np.zeros(len(own)),
    )
