"""The inner stage between a law and the bridge: current limit, current and voltage loops.

A law gives the internal voltage E_u and the frequency omega_u. Without an inner stage the bridge
produces E_u itself, as in the paper. With one, the measured currents and voltages of the filter
(i, v, i_o in the converter's dq frame) and E = E_u + j 0 give the bridge's voltage e = e_d + j e_q:

* ``virtual-stator``: a reference current behind a virtual impedance,
  (X_v/omega_b) di/dt = E - v - (R_v + j omega X_v) i, which the limit cuts to i*, then a current
  loop;
* ``cascaded``: a PI voltage loop around v* = E - (R_v + j omega X_v) i_o gives i*, which the limit
  cuts, then the current loop;
* ``threshold-impedance``: as ``cascaded``, and beyond the threshold v* falls by
  k_thr (|i_f| - I_thr) (1 + j omega sigma) i_f besides, where i_f is the low-pass filtered current.

The current loop is e = v_f + (k_c + k_ci/s) (i* - i) + j omega L_f i with the low-pass filtered
voltage v_f, and |e| <= m v_dc. Around them: a power limiter that lowers (raises) omega_u while p is
above P_max (below P_min), a frequency measurement (PLL) that replaces the reference omega_g of
column 3, and the freeze of the E_u row's states where they would lead further into the limit.

The stator's own current is not cut. If it were, the cut would act like a resistance in series with
the virtual impedance: the limited current would come in phase with E - v, and after a large jump of
the grid's angle carry no power that could bring the angle back.

Sources: the structures are those of Paquette and Divan (IEEE Trans. Ind. Appl. 51(2), 2015:
virtual impedance current limiting), Qoria et al. (IEEE Open Access J. Power Energy 7, 2020:
threshold virtual impedance, X/R 5, 0.67 p.u.), and the cascaded loops of Yazdani and Iravani,
"Voltage-Sourced Converters in Power Systems", chapter 8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.errors import LawError, Mistakes
from gfm_runtime.signals import NU, SPACE_VECTOR, group

KINDS = {"none": 0, "virtual-stator": 1, "cascaded": 2, "threshold-impedance": 3}
NONE, STATOR = KINDS["none"], KINDS["virtual-stator"]
P_LOW, P_HIGH = next((s.low, s.high) for s in group("y") if s.name == "p")  # p.u.
PRIORITIES = {"circular": 0, "d": 1, "q": 2, "angle": 3}
_D, _Q, _ANGLE = 1, 2, 3

PAPER_M = SPACE_VECTOR * 700.0 / 380.0
"""Largest |e| over v_dc by space-vector modulation for the paper's 700 V and 380 V, p.u."""

NEGLIGIBLE = 2.0**-100  # p.u.; decaying values below it become 0; exact in float32 too
_NEVER = 1e6  # p.u.; stands for infinity, times which 0 is no number
_LEAST_V = 0.05  # p.u.; the PLL holds its frequency below

V_DC, P, OMEGA, I_D, I_Q, V_D, V_Q, I_OD, I_OQ = range(9)
"""Places of the measurements in ``state.m``: those that the inner stage uses, in this order."""


@dataclass(frozen=True)
class Inner:
    """The parameters of an inner stage; those of another kind than ``kind`` do not act.

    Attributes:
        kind: a key of ``KINDS``.
        I_max: limit of |i*|, p.u.
        priority: a key of ``PRIORITIES``: circular keeps the angle of i*; d (q) gives the active
            (reactive) current the whole limit first; angle sets the limited i* to ``angle``.
        angle: of the limited i* against the converter's d axis, degrees (priority angle).
        R_v, X_v: virtual impedance, p.u.
        k_c, k_ci: current loop, p.u./p.u. and 1/s.
        L_f, C_f: the converter's own filter, p.u.
        f_v: bandwidth of the low-pass on v, Hz.
        k_v, k_vi: voltage loop, p.u./p.u. and 1/s (not virtual-stator).
        k_ff: part of i_o that is fed forward (not virtual-stator).
        I_thr, k_thr, sigma: threshold, p.u.; impedance per current beyond it; its X/R
            (threshold-impedance).
        f_i: bandwidth of the low-pass on i, Hz (threshold-impedance).
        m: limit of |e| over v_dc, p.u.; infinite for none.
        freeze: while the current is limited, hold the states of the E_u row if they would move E_u
            further away from v_d.
        P_max, P_min: where the power limiter begins, p.u.; infinite for none.
        k_P, k_Pi: the power limiter, p.u. of omega_u per p.u. of power, and 1/s.
        f_pll: bandwidth of the PLL that measures omega_g for column 3, Hz; 0 for none.
    """

    kind: str = "virtual-stator"
    I_max: float = 1.2
    priority: str = "circular"
    angle: float = 0.0
    R_v: float = 0.1
    X_v: float = 0.3
    k_c: float = 0.15
    k_ci: float = 0.0
    L_f: float = 0.0174
    C_f: float = 0.2268
    f_v: float = 400.0
    k_v: float = 1.0
    k_vi: float = 100.0
    k_ff: float = 0.6
    I_thr: float = 1.0
    k_thr: float = 0.67
    sigma: float = 2.0
    f_i: float = 10.0
    m: float = PAPER_M
    freeze: bool = True
    P_max: float = math.inf
    P_min: float = -math.inf
    k_P: float = 0.1
    k_Pi: float = 5.0
    f_pll: float = 0.0

    def __post_init__(self) -> None:
        mistakes = Mistakes()

        def check(name: str, good: bool, allowed: str) -> None:
            with mistakes.noting():
                if not good:
                    value = getattr(self, name)
                    raise LawError(f"inner.{name}", f"{value!r} must be {allowed}")

        for name in ("I_max", "k_c", "L_f", "f_v", "I_thr", "f_i", "m"):
            check(name, getattr(self, name) > 0.0, "> 0")
        check("X_v", self.X_v > 0.0 or self.kind != "virtual-stator", "> 0")
        least = (
            "R_v",
            "X_v",
            "k_ci",
            "C_f",
            "k_v",
            "k_vi",
            "k_ff",
            "k_thr",
            "sigma",
            "k_P",
            "k_Pi",
        )
        for name in (*least, "f_pll"):
            check(name, getattr(self, name) >= 0.0, ">= 0")
        check("P_max", self.P_max > self.P_min, f"above P_min = {self.P_min!r}")
        mistakes.check()

    def pack(self, rec: Any, T_s: float, omega_b: float) -> None:
        """Fill the fields of ``INNER_FIELDS`` in a law's record."""
        turn = omega_b * T_s
        rec["inner"], rec["priority"] = KINDS[self.kind], PRIORITIES[self.priority]
        rec["freeze"] = self.freeze and self.kind != "none"
        rec["I_cos"] = self.I_max * math.cos(math.radians(self.angle))
        rec["I_sin"] = self.I_max * math.sin(math.radians(self.angle))
        for name in _PLAIN:
            rec[name] = np.clip(getattr(self, name), -_NEVER, _NEVER)
        if self.kind != "threshold-impedance":
            rec["k_thr"] = 0.0
        rec["one"], rec["half_turn"], rec["least_v"] = 1.0, turn / 2, _LEAST_V
        if self.kind == "virtual-stator":
            rec["stator_a"] = self.R_v / self.X_v * turn / 2
            rec["stator_b"] = turn / self.X_v
        rec["T_k_ci"], rec["T_k_vi"] = T_s * self.k_ci, T_s * self.k_vi
        rec["T_k_Pi"] = T_s * self.k_Pi
        rec["follow_v"] = -math.expm1(-2 * math.pi * self.f_v * T_s)
        rec["follow_i"] = -math.expm1(-2 * math.pi * self.f_i * T_s)
        omega_n = 2 * math.pi * self.f_pll  # damping ratio 1/sqrt(2)
        rec["k_pll"] = math.sqrt(2) * omega_n / omega_b
        rec["T_k_pll"] = T_s * omega_n**2 / omega_b

    def internal_voltage(
        self, i: complex, v: complex, i_o: complex, e: complex, omega: float
    ) -> complex:
        """The E at which the stage rests, for a filter that rests under e; all in one dq frame.

        Args:
            i, v, i_o, e: currents and voltages, p.u.
            omega: p.u.

        Raises:
            LawError: the limit does not let the stage rest there.
        """
        Z_v = complex(self.R_v, omega * self.X_v)
        i_ref = i if self.k_ci > 0.0 else i + (e - v - 1j * omega * self.L_f * i) / self.k_c
        if abs(i_ref) > self.I_max:
            raise LawError(
                "inner.I_max", f"{self.I_max:g} p.u.: this operating point needs {abs(i_ref):.4g}"
            )
        if self.kind == "virtual-stator":
            return v + Z_v * i_ref
        beyond = max(abs(i) - self.I_thr, 0.0) if self.kind == "threshold-impedance" else 0.0
        return v + Z_v * i_o + self.k_thr * beyond * complex(1.0, omega * self.sigma) * i


_PLAIN = (
    "I_max", "R_v", "X_v", "k_c", "L_f", "C_f", "k_v", "k_ff", "I_thr", "k_thr", "sigma", "m",
    "P_max", "P_min", "k_P",
)  # fmt: skip
_PACKED = (
    "one", "half_turn", "I_cos", "I_sin", "stator_a", "stator_b", "T_k_ci", "T_k_vi", "T_k_Pi",
    "follow_v", "follow_i", "k_pll", "T_k_pll", "least_v",
)  # fmt: skip


#: the stage's constants in ``law_dtype``, in the law's precision
INNER_CONSTANTS = (*_PLAIN, *_PACKED)

#: integers of the stage in ``law_dtype``: places in ``KINDS`` and ``PRIORITIES``, and yes or no
INNER_NUMBERS = [("inner", "i8"), ("priority", "i8"), ("freeze", "i8")]


#: variables of the stage: name, size, what it is, in the converter's dq frame, p.u.
INNER_STATE = (
    ("i_ref", 2, "reference current, limited"),
    ("v_f", 2, "low-pass filtered v"),
    ("i_f", 2, "low-pass filtered i"),
    ("x_c", 2, "integral of the current loop"),
    ("x_v", 2, "integral of the voltage loop, or current of the virtual stator"),
    ("away", 2, "voltage that a change of law left; decays"),
    ("e", 2, "the bridge's voltage of the last tick"),
    ("pll", 2, "unit phasor that follows v"),
    ("omega_pll", 1, "frequency of the PLL"),
    ("x_high", 1, "integrals of the power limiter"),
    ("x_low", 1, ""),
)


def inner_fields(f: np.dtype[Any]) -> list[Any]:
    """The inner stage's constants in ``law_dtype``."""
    return [(name, f) for name in INNER_CONSTANTS]


def inner_state_fields(f: np.dtype[Any]) -> list[Any]:
    """The inner stage's variables in ``state_dtype``."""
    return [
        ("m", f, (9,)),  # measurements of this tick
        ("omega", f),  # omega_u after the power limiter
        ("drop", f, (2,)),  # voltage over the threshold impedance
        ("e_now", f, (2,)),  # the bridge's voltage of this tick
        *((name, f, (size,)) if size > 1 else (name, f) for name, size, _ in INNER_STATE),
    ]


@inlined
def limited(value, low, high):
    """The value, or the limit that it passes. A NaN stays: the controller finds it."""
    value = max(value, low)
    return min(value, high)


@inlined
def faded(value):
    """0 for a value that has decayed: subnormal numbers can double the time of a tick."""
    return 0.0 if abs(value) < NEGLIGIBLE else value


@inlined
def take_measurements(state, y):
    """What the stage needs from y (11,), p.u."""
    for j in range(3):
        state.m[j] = y[j]
    for j in range(6):
        state.m[I_D + j] = y[5 + j]


@inlined
def measure_frequency(law, state):
    """One tick of the PLL on v: omega_pll is then the measured omega_g, p.u."""
    m, cosine, sine = state.m, state.pll[0], state.pll[1]
    size = math.sqrt(m[V_D] * m[V_D] + m[V_Q] * m[V_Q])
    error = m[V_Q] * cosine - m[V_D] * sine
    if size > law.least_v:  # else there is no voltage to follow
        error = error / size
    state.omega_pll += law.T_k_pll * error
    h = (state.omega_pll + law.k_pll * error - m[OMEGA]) * law.half_turn
    # times (1 + j h) / (1 - j h), whose modulus is 1; the root takes the rounding out
    a, b = law.one - h * h, h + h
    turned_d, turned_q = a * cosine - b * sine, a * sine + b * cosine
    length = math.sqrt(turned_d * turned_d + turned_q * turned_q)
    state.pll[0], state.pll[1] = turned_d / length, turned_q / length


@inlined
def _limit_power(law, state):
    """omega_u lowered while p is above P_max and raised while it is below P_min, p.u."""
    over, under = state.m[P] - law.P_max, law.P_min - state.m[P]
    state.x_high += law.T_k_Pi * over
    if state.x_high < 0:
        state.x_high = 0
    state.x_low += law.T_k_Pi * under
    if state.x_low < 0:
        state.x_low = 0
    lower, raise_by = law.k_P * over + state.x_high, law.k_P * under + state.x_low
    if lower > 0:
        state.omega -= lower
    if raise_by > 0:
        state.omega += raise_by
    state.omega = limited(state.omega, law.low[1], law.high[1])


@inlined
def _limit_current(law, state):
    """i* cut to I_max, and whether that was needed."""
    d, q = state.i_ref[0], state.i_ref[1]
    size = d * d + q * q
    most = law.I_max * law.I_max
    state.limited = size > most
    if not state.limited:
        return
    if law.priority == _ANGLE:
        state.i_ref[0], state.i_ref[1] = law.I_cos, law.I_sin
    elif law.priority == _D:
        d = limited(d, -law.I_max, law.I_max)
        rest = math.sqrt(most - d * d)
        state.i_ref[0], state.i_ref[1] = d, limited(q, -rest, rest)
    elif law.priority == _Q:
        q = limited(q, -law.I_max, law.I_max)
        rest = math.sqrt(most - q * q)
        state.i_ref[0], state.i_ref[1] = limited(d, -rest, rest), q
    else:
        scale = law.I_max / math.sqrt(size)
        state.i_ref[0], state.i_ref[1] = d * scale, q * scale


@inlined
def _stator(law, state, E_d, E_q):
    """One tick of the virtual stator by the trapezoidal rule on its own pole: i* from E - v."""
    m = state.m
    b = state.omega * law.half_turn
    keep, lose = law.one - law.stator_a, law.one + law.stator_a
    d, q = state.x_v[0], state.x_v[1]
    r_d = keep * d + b * q + law.stator_b * (E_d - m[V_D])
    r_q = keep * q - b * d + law.stator_b * (E_q - m[V_Q])
    size = lose * lose + b * b
    state.x_v[0], state.x_v[1] = (r_d * lose + r_q * b) / size, (r_q * lose - r_d * b) / size
    state.i_ref[0], state.i_ref[1] = state.x_v[0], state.x_v[1]
    _limit_current(law, state)


@inlined
def _drop(law, state):
    """The voltage k_thr (|i_f| - I_thr) (1 + j omega sigma) i_f over the threshold impedance; 0
    below the threshold."""
    state.drop[0] = state.drop[1] = 0
    if law.k_thr > 0:
        d, q = state.i_f[0], state.i_f[1]
        beyond = math.sqrt(d * d + q * q) - law.I_thr
        if beyond > 0:
            R = law.k_thr * beyond
            X = R * state.omega * law.sigma
            state.drop[0], state.drop[1] = R * d - X * q, R * q + X * d


@inlined
def _voltage_loop(law, state, E_d, E_q):
    """One tick of the cascaded voltage loop: i* from v* - v; it integrates only within the
    limit."""
    m, X = state.m, state.omega * law.X_v
    _drop(law, state)
    E_d -= state.drop[0]
    E_q -= state.drop[1]
    error_d = E_d - law.R_v * m[I_OD] + X * m[I_OQ] - m[V_D]
    error_q = E_q - law.R_v * m[I_OQ] - X * m[I_OD] - m[V_Q]
    B = state.omega * law.C_f
    state.i_ref[0] = law.k_v * error_d + state.x_v[0] + law.k_ff * m[I_OD] - B * m[V_Q]
    state.i_ref[1] = law.k_v * error_q + state.x_v[1] + law.k_ff * m[I_OQ] + B * m[V_D]
    _limit_current(law, state)
    if not state.limited:
        state.x_v[0] += law.T_k_vi * error_d
        state.x_v[1] += law.T_k_vi * error_q
    state.limited = state.limited != 0 or state.drop[0] != 0 or state.drop[1] != 0


@inlined
def _current_loop(law, state):
    """One tick of the current loop: e from i* - i, before the limit of modulation."""
    m, X = state.m, state.omega * law.L_f
    error_d, error_q = state.i_ref[0] - m[I_D], state.i_ref[1] - m[I_Q]
    state.e_now[0] = state.v_f[0] + law.k_c * error_d + state.x_c[0] - X * m[I_Q]
    state.e_now[1] = state.v_f[1] + law.k_c * error_q + state.x_c[1] + X * m[I_D]
    state.x_c[0] += law.T_k_ci * error_d
    state.x_c[1] += law.T_k_ci * error_q


@inlined
def _follow(law, state):
    """One tick of the low-passes on v and i."""
    m = state.m
    for k in range(2):
        state.v_f[k] += law.follow_v * (m[V_D + k] - state.v_f[k])
        state.i_f[k] += law.follow_i * (m[I_D + k] - state.i_f[k])


@inlined
def shape(law, state):
    """One tick of the inner stage: the bridge's voltage e from E_u, and omega_u after the power
    limiter, p.u.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``, between ``output`` and ``advance``
            of the law; ``take_measurements`` was called.
    """
    E_d, E_q = state.now[2] + state.away[0], state.away[1]
    state.omega = state.now[1]
    if law.inner == NONE:
        state.limited = 0
        state.e_now[0], state.e_now[1] = E_d, E_q
    else:
        if law.P_max < P_HIGH or law.P_min > P_LOW:
            _limit_power(law, state)
        _follow(law, state)
        if law.inner == STATOR:
            _stator(law, state, E_d, E_q)
        else:
            _voltage_loop(law, state, E_d, E_q)
        _current_loop(law, state)
        most = law.m * state.m[V_DC]
        size = state.e_now[0] * state.e_now[0] + state.e_now[1] * state.e_now[1]
        if size > most * most:  # the limit of the modulation
            scale = most / math.sqrt(size)
            state.e_now[0] *= scale
            state.e_now[1] *= scale
    for k in range(2):
        state.away[k] = faded(state.away[k] * law.decay)


@inlined
def settle_inner(law, state, e_d, e_q):
    """The state of the stage with which the bridge's voltage goes on at e: at the start, and when
    another law takes over. What the structure cannot absorb goes into away.

    Args:
        law, state: as for ``shape``; ``state.now`` is the law's output.
        e_d, e_q: p.u.
    """
    m = state.m
    state.omega = state.omega_pll = state.now[1]
    size = math.sqrt(m[V_D] * m[V_D] + m[V_Q] * m[V_Q])
    state.pll[0], state.pll[1] = law.one, 0
    if size > law.least_v:
        state.pll[0], state.pll[1] = m[V_D] / size, m[V_Q] / size
    state.x_high, state.x_low, state.limited = 0, 0, 0
    for k in range(2):
        state.v_f[k], state.i_f[k], state.i_ref[k] = m[V_D + k], m[I_D + k], m[I_D + k]
        state.x_c[k] = state.x_v[k] = 0
    state.e[0], state.e[1] = e_d, e_q
    need_d, need_q = state.e[0], state.e[1]  # in the law's own precision
    if law.inner != NONE:
        X = state.omega * law.L_f
        lack_d, lack_q = need_d - m[V_D] + X * m[I_Q], need_q - m[V_Q] - X * m[I_D]
        if law.T_k_ci > 0:
            state.x_c[0], state.x_c[1] = lack_d, lack_q
        else:
            state.i_ref[0] += lack_d / law.k_c
            state.i_ref[1] += lack_q / law.k_c
        through_d, through_q = state.i_ref[0], state.i_ref[1]
        state.x_v[0], state.x_v[1] = through_d, through_q
        state.drop[0] = state.drop[1] = 0
        if law.inner != STATOR:
            _drop(law, state)
            B = state.omega * law.C_f
            state.x_v[0] = through_d - law.k_ff * m[I_OD] + B * m[V_Q]
            state.x_v[1] = through_q - law.k_ff * m[I_OQ] - B * m[V_D]
            through_d, through_q = m[I_OD], m[I_OQ]
        X = state.omega * law.X_v
        need_d = m[V_D] + law.R_v * through_d - X * through_q + state.drop[0]
        need_q = m[V_Q] + law.R_v * through_q + X * through_d + state.drop[1]
    state.away[0], state.away[1] = need_d - state.now[2], need_q


@compiled
def settle(law, state, u, y, e_d, e_q):
    """``settle_inner`` from Python: one-element arrays of the records, and y (11,), p.u."""
    take_measurements(state[0], y)
    for i in range(NU):
        state[0].now[i] = u[i]
    settle_inner(law[0], state[0], e_d, e_q)
