"""What a grid-forming unit of given damping, inertia and reactance is expected to do, and the fit.

The unit is a voltage behind X_eff whose angle follows the swing equation 2 H w' = -P - D w, on a
grid of reactance 1/SCR; all powers are changes, p.u. of its rating. The responses and envelopes are
those of DyCoV (dynawo/dyn-grid-compliance-verification, RTE and AIA, MPL-2.0), `generateEnvelopes`
for the French DTR sheet I18, written anew from its published method. They reproduce two things
that a derivation would not give:

- after a phase jump an overdamped unit has the numerator s + D/(2H), an underdamped one s + 1
  (with D/(2H) = 9.5 1/s in DyCoV's own example this is not the same);
- after a ramp of frequency the power settles at 2 H + D T_pll times the rate: the damping acts
  against a PLL and not against the nominal frequency, so that no droop is known.

The tolerances and rules of DyCoV change from version to version; those here are of the curves under
docs/GFM_envelopes_curves at its commit b7576cb0. No curve of an SCR jump of an underdamped unit was
published there: this case follows the code of commit 013401e3. What DyCoV does at the limits of
power is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from scipy.optimize import least_squares

from gfm_hil.core.errors import UserError

Vector = NDArray[np.float64]
Response = NDArray[np.complex128]

OMEGA_B = 314.0  # rad/s, as DyCoV rounds it
_APART = 1e-5  # of the poles' size; closer ones are moved this far from each other
_FAR = 30.0  # of the logarithms of a fit, where there is none
_TUNNEL_S, _TUNNEL_FROM = 0.3, 0.02  # s; how the tunnel opens
_T_90 = 0.01  # s; reactive current after a step of the grid's voltage
_HALF, _HALF_S, _HALF_LEAST = 0.5, 0.03, 0.005  # after an SCR jump: of the change, s, p.u.
_WIDE_S = 0.08  # s; until when its upper limit is wider


@dataclass(frozen=True)
class Unit:
    """A grid-forming unit as the envelopes know it.

    Raises:
        UserError: a value that cannot be.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # where a file declares one

    D: Annotated[float, Field(ge=0, description="damping, p.u. of power over p.u. of frequency")]
    H: Annotated[float, Field(gt=0, description="inertia constant, s")]
    X_eff: Annotated[float, Field(gt=0, description="effective reactance, p.u. of the unit")]

    def __post_init__(self) -> None:
        for name in ("D", "H", "X_eff"):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (name == "D" and value == 0))):
                raise UserError(f"{name} = {value}: must be {'>= 0' if name == 'D' else '> 0'}")

    def times(self, D: float, H: float) -> Unit:
        """The unit with other damping and inertia, as factors."""
        return Unit(self.D * D, self.H * H, self.X_eff)

    def inertia(self, digits: int = 3) -> str:
        """H for people; what a fit leaves of none is 0."""
        return f"H = {round(self.H, 6):.{digits}g} s"

    def damping_ratio(self, X: float, omega_b: float = OMEGA_B) -> float:
        """Damping ratio of the swing on a total reactance X, p.u.; omega_b in rad/s."""
        return self.D / 2 * math.sqrt(X / (2 * self.H * omega_b))

    def swing(self, X: float, omega_b: float = OMEGA_B) -> list[float]:
        """The polynomial s^2 + D/(2H) s + omega_b/(2 H X), in falling powers of s [1/s]."""
        return [1.0, self.D / (2 * self.H), omega_b / (2 * self.H * X)]


@dataclass(frozen=True)
class Tolerance:
    """What an envelope allows; the defaults are those of DyCoV's published curves.

    Attributes:
        low, high: of the expected change. After a phase jump of an overdamped unit the limits are
            high times it, from ``start_s`` on, and 1 + low times it; of an underdamped one 1 - low
            and 1 + high times the decay. After a ramp or a jump of the SCR the lower limit allows
            for low of it, and the upper one for high of it, either way.
        ratio: factors of D, at which H is divided by the same, whose responses are allowed too.
        part, least: the tunnel that opens around the response: a part of the first change, and
            least p.u.
        start_s: time until the smaller response must be there, s.
        delay_s: by which all is late for waveforms, where power is a mean over a cycle, s.
    """

    low: float = 0.4
    high: float = 0.4
    ratio: tuple[float, float] = (0.85, 1.15)
    part: float = 0.05
    least: float = 0.02
    start_s: float = 0.01
    delay_s: float = 0.02


@dataclass(frozen=True)
class Envelope:
    """An expected response and the limits around it, shape (K,) each.

    Attributes:
        t: s after the event.
        expected, lower, upper: p.u.
    """

    t: Vector
    expected: Vector
    lower: Vector
    upper: Vector

    def outside(self, t: Sequence[float] | Vector, x: Sequence[float] | Vector) -> Vector:
        """By how much x [p.u.] at t [s after the event] is outside, shape (len(t),); 0 inside."""
        low, high = (np.interp(t, self.t, limit) for limit in (self.lower, self.upper))
        return np.asarray(np.maximum(np.maximum(low - x, np.asarray(x) - high), 0.0))


def phase_jump(
    unit: Unit,
    t: Vector,
    radians: float,
    scr: float,
    P_0: float,
    tolerance: Tolerance | None = None,
) -> Envelope:
    """The envelope of P after the grid's angle jumps ahead.

    Args:
        t: s after the event, evenly apart, from 0 on.
        radians: of the jump.
        scr: short-circuit ratio.
        P_0: power before, p.u.

    Raises:
        UserError: a value that cannot be.
    """
    rule, X = tolerance or Tolerance(), unit.X_eff + _reactance(scr)
    first = abs(radians) / X
    units = [unit, *(unit.times(k, 1 / k) for k in rule.ratio)]
    each = [first * jump_response(one, t, X) for one in units]
    if unit.damping_ratio(X) > 1:
        less, more = rule.high * each[0], (1 + rule.low) * each[0]
    else:  # around the decay of the oscillation, which both limits follow
        decay = first * np.exp(-unit.D / (4 * unit.H) * t)
        less, more = (1 - rule.low) * decay, (1 + rule.high) * decay
        more = _late(t, rule.start_s, more, more[0])
    each += [more, _late(t, rule.start_s, less, 0.0)]
    opens = max(rule.least, rule.part * first) * (1 - np.exp((_TUNNEL_FROM - t) / _TUNNEL_S))
    least, most = np.min(each, axis=0) - opens, np.max(each, axis=0) + opens
    sign = math.copysign(1.0, radians)
    curves = (P_0 - sign * x for x in (each[0], least, most))
    expected, one, other = (_late(t, rule.delay_s, x, x[0]) for x in curves)
    return Envelope(t, expected, np.minimum(one, other), np.maximum(one, other))


def rocof(
    unit: Unit,
    t: Vector,
    rate: float,
    scr: float,
    P_0: float,
    T_pll: float = 0.01,
    lasts: float = math.inf,
    tolerance: Tolerance | None = None,
) -> Envelope:
    """The envelope of P during and after a ramp of the grid's frequency.

    Args:
        t, rate, scr, T_pll, lasts: as for ``rocof_response``; t evenly apart.
        P_0: power before, p.u.

    Raises:
        UserError: a value that cannot be.
    """
    rule = tolerance or Tolerance(low=0.5, high=0.3, ratio=(0.8, 1.2))
    units = [unit, *(unit.times(k, 1 / k) for k in rule.ratio)]
    each = [rocof_response(one, t, rate, scr, T_pll, lasts) for one in units]
    poles, weights = _ramp_modes(unit, scr, T_pll)
    swings = (np.abs(poles.imag) > 0) & (weights != 0)  # the other poles are those of ramp and PLL
    peak = abs(rate * np.sum(weights[poles == 0]).real)
    if swings.any():  # DyCoV adds the amplitudes of all that is in it
        peak = abs(rate) * abs(np.sum(weights[~swings]).real + np.sum(np.abs(weights[swings])))
    tunnel = max(rule.least, rule.part * peak)
    way = math.copysign(1.0, -rate)
    up, down = 1 + way * rule.high, 1 - way * rule.low
    most = P_0 + np.max(each, axis=0) * up + tunnel
    least = P_0 + np.min(each, axis=0) * down - tunnel
    settled = 4 * max(T_pll, *(-1 / np.roots(unit.swing(unit.X_eff + _reactance(scr))).real))
    steady = (t >= settled) & (t < lasts)
    if settled < lasts and steady.any():
        level = P_0 + float(np.interp(settled, t, each[0]))
        most, least = (
            np.where(steady, level + x, limit) for x, limit in ((tunnel, most), (-tunnel, least))
        )
    after = t >= lasts
    if after.any() and not after.all():  # what returns does not pass where it was
        last = int(np.argmax(after)) - 1
        if way < 0:
            least = np.where(after, np.maximum(least, least[last]), least)
        else:
            most = np.where(after, np.minimum(most, most[last]), most)
    return _delay_envelope(rule, t, P_0, tunnel, P_0 + each[0], least, most)


def scr_jump(
    unit: Unit,
    t: Vector,
    before: float,
    after: float,
    P_0: float,
    tolerance: Tolerance | None = None,
) -> Envelope:
    """The envelope of P after the short-circuit ratio jumps.

    Args:
        t, before, after, P_0: as for ``scr_jump_response``; t evenly apart.

    Raises:
        UserError: a value that cannot be.
    """
    rule = tolerance or Tolerance(low=0.2, high=0.2, ratio=(0.8, 1.2))
    X = unit.X_eff + _reactance(after)
    first = (_reactance(before) - _reactance(after)) * P_0 / X
    units = [unit, *(unit.times(k, 1 / k) for k in rule.ratio)]
    each = [scr_jump_response(one, t, before, after, P_0) for one in units]
    tunnel = max(rule.least, rule.part * abs(first))
    sign = math.copysign(1.0, first)
    further, less = (rule.high, rule.low) if sign > 0 else (rule.low, rule.high)
    # sign times the change: at most, and at least
    most = [sign * x * (1 + further) + tunnel for x in each]
    least = [sign * x * (1 - less) - tunnel for x in each]
    for one in units:
        if one.damping_ratio(X) < 1:  # around the decay of the oscillation
            zero, decay = one.D / (2 * one.H), one.D / (4 * one.H)
            beside = (zero - decay) / math.sqrt(one.swing(X)[2] - decay**2)
            size = abs(first) * math.hypot(1.0, beside) * np.exp(-decay * t)
            most.append(size * (1 + further) + tunnel)
            least.append(-size * (1 - less) - tunnel)
    half = _HALF * sign * np.array(each)
    smallest = np.minimum(np.min(least, axis=0), half[0])
    smallest = np.where(t <= _HALF_S, np.min(half, axis=0) - _HALF_LEAST, smallest)
    one, other = P_0 + sign * np.max(most, axis=0), P_0 + sign * smallest
    limits = np.minimum(one, other), np.maximum(one, other)
    return _delay_envelope(rule, t, P_0, tunnel, P_0 + each[0], *limits)


def _delay_envelope(
    rule: Tolerance, t: Vector, P_0: float, tunnel: float, expected: Vector, low: Vector, up: Vector
) -> Envelope:
    """An envelope that is late, and before that around the power before."""
    curves = (expected, P_0), (low, P_0 - tunnel), (up, P_0 + tunnel)
    return Envelope(t, *(_late(t, rule.delay_s, x, first) for x, first in curves))


def amplitude_step(
    unit: Unit, t: Vector, step: float, scr: float, tolerance: Tolerance | None = None
) -> Envelope:
    """The envelope of the reactive current after the grid's voltage falls by ``step`` p.u.

    X_eff is that against a change of voltage. Arguments and errors as for ``phase_jump``.
    """
    rule, X = tolerance or Tolerance(high=0.3), unit.X_eff + _reactance(scr)
    final = step / X
    tunnel = max(rule.least, rule.part * abs(final))
    expected = abs(final) * (1 - np.exp(t * math.log(0.1) / _T_90))
    least = np.minimum(expected, abs(final) - tunnel)
    wide = abs(final) * (1 + rule.high * np.exp(-3 * t / _WIDE_S)) + tunnel
    most = np.where(t < _WIDE_S, wide, abs(final) + tunnel)
    sign = math.copysign(1.0, final)
    one, other = (sign * _late(t, rule.delay_s, x, x[0]) for x in (least, most))
    return Envelope(t, sign * expected, np.minimum(one, other), np.maximum(one, other))


def jump_response(unit: Unit, t: Vector, X: float, omega_b: float = OMEGA_B) -> Vector:
    """Power after a phase jump over the first power, shape as t [s]; X is the total reactance."""
    zero = unit.D / (2 * unit.H) if unit.damping_ratio(X, omega_b) > 1 else 1.0
    return _impulse([1.0, zero], unit.swing(X, omega_b), t)


def rocof_response(
    unit: Unit, t: Vector, rate: float, scr: float, T_pll: float = 0.01, lasts: float = math.inf
) -> Vector:
    """The expected change of P during and after a ramp of the grid's frequency, p.u.

    Args:
        t: s after the event.
        rate: p.u. of frequency per s.
        T_pll: time constant of the PLL against which the damping acts, s.
        lasts: how long the ramp lasts, s.
    """
    poles, weights = _ramp_modes(unit, scr, T_pll)

    def ramp(since: Vector) -> Vector:
        return np.where(since >= 0, _sum(poles, weights, np.maximum(since, 0.0)), 0.0)

    return np.asarray(-rate * (ramp(t) - (ramp(t - lasts) if math.isfinite(lasts) else 0.0)))


def _ramp_modes(unit: Unit, scr: float, T_pll: float) -> tuple[Response, Response]:
    """The poles of the response to a ramp of -1 p.u./s, and their weights."""
    swing = unit.swing(unit.X_eff + _reactance(scr))
    numerator = swing[2] * np.array([2 * unit.H * T_pll, 2 * unit.H + unit.D * T_pll])
    return modes(numerator, np.asarray(np.polymul([T_pll, 1.0, 0.0], swing), float))


def scr_jump_response(unit: Unit, t: Vector, before: float, after: float, P_0: float) -> Vector:
    """The expected change of P after the short-circuit ratio jumps, p.u., shape as t [s].

    Args:
        before, after: short-circuit ratios.
        P_0: power before, p.u.
    """
    X = unit.X_eff + _reactance(after)
    first = (_reactance(before) - _reactance(after)) * P_0 / X
    return first * _impulse([1.0, unit.D / (2 * unit.H)], unit.swing(X), t)


def fit_jump(
    t: Vector, change: Vector, radians: float, omega_b: float, X_grid: float, skip_s: float = 0.0
) -> Unit:
    """The unit whose swing equation fits a change of power after a phase jump.

    The numerator is s + D/(2H) in any case, as the swing equation has it.

    Args:
        t, change: s after the jump, and p.u., shape (K,).
        radians: by which the grid's angle jumped ahead.
        omega_b: rad/s.
        X_grid: reactance between the unit and the grid's voltage, p.u.; it is not part of X_eff.
        skip_s: what is left out at the beginning, s: the circuit's own transient.

    Raises:
        UserError: nothing fits.
    """
    used = t >= skip_s
    at, p = t[used], change[used]

    def off(X: float, zero: float, stiff: float) -> Vector:
        return -radians / X * _impulse([1.0, zero], [1.0, zero, stiff], at) - p

    largest = float(np.abs(p).max())
    if not largest > 0:
        raise UserError("fit: the power does not change")
    X, zero, stiff = np.exp(fit_swing(off, abs(radians) / largest, 0.1 * largest).x)
    H = omega_b / (2 * stiff * X)
    X_eff = float(X - X_grid)
    if X_eff <= 0:
        raise UserError(f"fit: X = {X:.4g} p.u. in all: must be above X_grid = {X_grid:g} p.u.")
    return Unit(float(2 * H * zero), float(H), X_eff)


def fit_nfp(hz: Vector, nfp: Response, omega_b: float) -> Unit:
    """The unit whose swing equation fits a plot of network frequency perturbation,
    -omega_b/X (s + D/2H)/(s^2 + D/2H s + omega_b/2HX); X_eff is all of X.

    Args:
        hz, nfp: frequencies and the change of power over that of the grid's frequency, p.u. over
            p.u., shape (K,).
        omega_b: rad/s.

    Raises:
        UserError: nothing fits.
    """
    s = 2j * np.pi * hz

    def off(X: float, zero: float, stiff: float) -> Vector:
        rest = -omega_b / X * (s + zero) / (s**2 + zero * s + stiff) - nfp
        return np.concatenate([rest.real, rest.imag])

    X, zero, stiff = np.exp(fit_swing(off, 0.5, 0.1 * float(np.abs(nfp).max())).x)
    H = omega_b / (2 * stiff * X)
    return Unit(float(2 * H * zero), float(H), float(X))


def fit_swing(off: Callable[[float, float, float], Vector], X_0: float, most: float) -> Any:
    """SciPy's result with the logarithms of X, D/2H and omega_b/2HX with which what is left is
    least, from a reactance to begin with. Raises UserError: more than ``most`` RMS is left."""

    def at(z: Vector) -> Vector:
        return off(*np.exp(np.clip(z, -_FAR, _FAR)))

    starts = [(zero, stiff) for zero in (1.0, 10.0, 100.0) for stiff in (10.0, 300.0, 3000.0)]
    found = [least_squares(at, np.log([X_0, *start]), x_scale=1.0) for start in starts]
    best = min(found, key=lambda one: one.cost)
    rms = math.sqrt(2 * best.cost / len(best.fun))
    if not rms < most:
        raise UserError(f"fit: no swing equation fits: {rms:.2g} p.u. RMS are left")
    return best


def fit_ramp(t: Vector, change: Vector, rate: float, settled_s: float) -> tuple[float, float]:
    """D and H by the power during a ramp of the grid's frequency, once transients are gone.

    Then P = -rate (D t + 2 H'), with H' = H - D^2 X / (2 omega_b) for a unit on a reactance X: the
    angle across X lags behind the ramp.

    Args:
        t, change: s after the beginning of the ramp, and p.u., shape (K,).
        rate: p.u. of frequency per s.
        settled_s: from when on the power is a straight line, s.

    Returns:
        D in p.u./p.u. and H' in s.

    Raises:
        UserError: fewer than two samples are left.
    """
    used = t >= settled_s
    if rate == 0.0 or np.count_nonzero(used) < 2:
        raise UserError(
            f"rate = {rate:g}, settled_s = {settled_s:g}: need a ramp, and samples in it"
        )
    slope, level = np.polyfit(t[used], change[used], 1)
    return float(-slope / rate), float(-level / (2 * rate))


def _reactance(scr: float) -> float:
    if not scr > 0:
        raise UserError(f"scr = {scr}: must be > 0")
    return 1.0 / scr


def _impulse(
    numerator: Sequence[float] | Vector, denominator: Sequence[float] | Vector, t: Vector
) -> Vector:
    """The impulse response of a strictly proper transfer function."""
    return _sum(*modes(numerator, denominator), t)


def modes(
    numerator: Sequence[float] | Vector, denominator: Sequence[float] | Vector
) -> tuple[Response, Response]:
    """The poles of a strictly proper transfer function, and their residues."""
    poles = np.roots(denominator).astype(complex)
    size = max(float(np.abs(poles).max()), 1e-12)
    for k in range(1, len(poles)):
        while (np.abs(poles[k] - poles[:k]) < _APART * size).any():
            poles[k] += 2 * _APART * size
    others = np.array([np.prod(pole - np.delete(poles, k)) for k, pole in enumerate(poles)])
    return poles, np.polyval(numerator, poles) / others / denominator[0]


def _sum(poles: Response, residues: Response, t: Vector) -> Vector:
    out = np.zeros(len(t), complex)
    with np.errstate(over="ignore", invalid="ignore"):  # of a unit almost without inertia
        for pole, residue in zip(poles, residues, strict=True):
            out += residue * np.exp(pole * t)
    return np.asarray(out.real)


def _late(t: Vector, seconds: float, x: Vector, before: float) -> Vector:
    """x by whole samples later, and ``before`` until then."""
    samples = int(seconds / (t[1] - t[0]))
    return np.concatenate([np.full(samples, before), x])[: len(x)]
