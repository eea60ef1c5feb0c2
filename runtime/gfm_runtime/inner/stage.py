"""What all inner stages have in common: the options, the limits, the current loop, the PLL.

Measured currents and voltages (i, v, i_o) and the bridge's voltage e are in the converter's dq
frame, p.u. The current loop is e = v_f + (k_c + k_ci/s) (i* - i) + j omega L_f i with the low-pass
filtered voltage v_f, and |e| <= m v_dc. Around it: a power limiter that lowers (raises) omega_u
while p is above P_max (below P_min), a frequency measurement (PLL) that replaces the reference
omega_g of column 3, and the freeze of the E_u row's states where they would lead further into the
limit.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from gfm_runtime.compiled import inlined
from gfm_runtime.errors import LawError
from gfm_runtime.signals import SPACE_VECTOR, group
from gfm_runtime.toml_file import NotNegative, Number, Positive, TomlTable

PRIORITIES = {"circular": 0, "d": 1, "q": 2, "angle": 3}
_D, _Q, _ANGLE = 1, 2, 3
P_LOW, P_HIGH = next((s.low, s.high) for s in group("y") if s.name == "p")  # p.u.

PAPER_M = SPACE_VECTOR * 700.0 / 380.0
"""Largest |e| over v_dc by space-vector modulation for the paper's 700 V and 380 V, p.u."""

NEGLIGIBLE = 2.0**-100  # p.u.; decaying values below it become 0; exact in float32 too
LEAST_V = 0.05  # p.u.; the PLL holds its frequency below
_NEVER = 1e6  # p.u.; stands for infinity, times which 0 is no number
_F_I = 10.0  # Hz; low-pass on i of a stage that does not set it

V_DC, P, OMEGA, I_D, I_Q, V_D, V_Q, I_OD, I_OQ = range(9)
"""Places of the measurements in ``state.m``: those that the inner stage uses, in this order."""

#: variables of the stage: name, size, what it is, in the converter's dq frame, p.u.
INNER_STATE = (
    ("i_ref", 2, "reference current, limited"),
    ("v_f", 2, "low-pass filtered v"),
    ("i_f", 2, "low-pass filtered i"),
    ("x_c", 2, "integral of the current loop"),
    ("x_v", 2, "integral of the voltage loop, or of v_dc, or current of the virtual stator"),
    ("away", 2, "voltage, if grid-following current, that a change of law left; decays"),
    ("e", 2, "the bridge's voltage of the last tick"),
    ("pll", 2, "unit phasor that follows v"),
    ("omega_pll", 1, "frequency of the PLL"),
    ("x_high", 1, "integrals of the power limiter"),
    ("x_low", 1, ""),
    ("i_p", 2, "positive sequence of the virtual stator's current"),
    ("i_n", 2, "negative sequence of the virtual stator's current"),
    ("E_p", 2, "positive sequence of E"),
    ("E_n", 2, "negative sequence of E"),
    ("slow", 2, "low-pass filtered P and Q of a stiff source"),
    ("level", 2, "low-pass filtered V, and I_d of a stiff source"),
    ("x_Q", 2, "integrals of the limits of Q"),
    ("window", 2, "largest and least angle of E against the PLL, rad"),
)


class PowerLimiter(TomlTable):
    """Lowers omega_u while p is above P_max, and raises it while p is below P_min."""

    P_max: Number = Field(description="p.u.")
    P_min: Number = Field(description="p.u.")
    k_p: NotNegative = Field(0.1, description="p.u. of omega_u per p.u. of power")
    k_i: NotNegative = Field(5.0, description="1/s")

    @model_validator(mode="after")
    def _ascending(self) -> PowerLimiter:
        numbers = isinstance(self.P_max, float) and isinstance(self.P_min, float)
        if numbers and not self.P_max > self.P_min:
            raise ValueError(f"P_max = {self.P_max!r} must be above P_min = {self.P_min!r}")
        return self


class InnerStage(TomlTable):
    """Base of the inner stages; in a law file a number may be an expression."""

    rows: ClassVar[tuple[int, ...]] = (0, 1, 2)
    """Rows of Phi that act, zero-based."""
    references: ClassVar[tuple[str, ...]] = ()
    """The references that the stage takes itself."""

    m: Positive = Field(PAPER_M, description="limit of abs(e) over v_dc, p.u.")
    freeze: bool = Field(
        True,
        description="while the current is limited, hold the states of the law's E_u row if they "
        "would move E_u further away from v_d",
    )
    power: PowerLimiter | None = Field(None, description="power limiter; none if not given")
    f_pll: NotNegative = Field(
        0.0,
        description="natural frequency of the PLL that measures omega_g for column 3, Hz; 0: none",
    )
    I_max: Positive = Field(1.2, description="limit of the current, p.u. of S_n/V_n")
    priority: Literal["circular", "d", "q", "angle"] = Field(
        "circular", description="what the limit keeps: the angle, i_d, i_q, or a set angle"
    )
    angle: Number = Field(0.0, description="of the limited current, degrees; priority angle only")
    k_c: Positive = Field(0.15, description="current loop, p.u./p.u.")
    k_ci: NotNegative = Field(0.0, description="current loop, 1/s")
    L_f: Positive = Field(0.0174, description="the converter's filter inductor, p.u.")
    f_v: Positive = Field(400.0, description="low-pass on v, Hz")

    @property
    def kind(self) -> str:
        """Which stage it is, as a file names it."""
        return str(type(self).model_fields["type"].default)

    @property
    def P_max(self) -> float:
        """Where the power limiter begins to lower omega_u, p.u.; infinite for none."""
        return self.power.P_max if self.power else math.inf

    @property
    def P_min(self) -> float:
        """Where the power limiter begins to raise omega_u, p.u.; infinite for none."""
        return self.power.P_min if self.power else -math.inf

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        """The stage's constants in ``law_dtype``, by name.

        Args:
            T_s: sampling time, s.
            omega_b: base frequency of the converter, rad/s.
        """
        angle, omega_n = math.radians(self.angle), 2 * math.pi * self.f_pll
        power = self.power or PowerLimiter(P_max=_NEVER, P_min=-_NEVER)
        return {
            "I_max": self.I_max,
            "I_cos": self.I_max * math.cos(angle),
            "I_sin": self.I_max * math.sin(angle),
            "k_c": self.k_c,
            "T_k_ci": T_s * self.k_ci,
            "L_f": self.L_f,
            "follow_v": -math.expm1(-2 * math.pi * self.f_v * T_s),
            "follow_i": -math.expm1(-2 * math.pi * _F_I * T_s),
            "m": min(self.m, _NEVER),
            "P_max": min(power.P_max, _NEVER),
            "P_min": max(power.P_min, -_NEVER),
            "k_P": power.k_p,
            "T_k_Pi": T_s * power.k_i,
            "k_pll": math.sqrt(2) * omega_n / omega_b,  # damping ratio 1/sqrt(2)
            "T_k_pll": T_s * omega_n**2 / omega_b,
        }

    def pack(self, rec: Any, T_s: float, omega_b: float) -> None:
        """Fill the stage's fields in a law's record; arguments as of ``constants``."""
        rec["priority"], rec["freeze"] = PRIORITIES[self.priority], self.freeze
        for name, value in self.constants(T_s, omega_b).items():
            rec[name] = value

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
        i_ref = self.reference(i, v, e, omega)
        self.check_current(abs(i_ref))
        return v + self.voltage_drop(i, i_o, i_ref, omega)

    def reference(self, i: complex, v: complex, e: complex, omega: float) -> complex:
        """The i* with which the current loop rests; arguments as of ``internal_voltage``."""
        return i if self.k_ci > 0.0 else i + (e - v - 1j * omega * self.L_f * i) / self.k_c

    def check_current(self, size: float) -> None:
        """Raise LawError if a steady current of this size, p.u., is beyond the limit."""
        if size > self.I_max:
            raise LawError(
                "inner.I_max", f"{self.I_max:g} p.u.: this operating point needs {size:.4g}"
            )

    def voltage_drop(self, i: complex, i_o: complex, i_ref: complex, omega: float) -> complex:
        """E - v at rest, p.u.; arguments as of ``internal_voltage``, i_ref the current i*."""
        raise NotImplementedError


def inner_state_fields(f: np.dtype[Any]) -> list[Any]:
    """The inner stage's variables in ``state_dtype``."""
    return [
        ("m", f, (9,)),  # measurements of this tick
        ("omega", f),  # omega_u after the power limiter
        ("drop", f, (2,)),  # voltage over the threshold impedance
        ("push", f),  # what a stiff source adds to the integrator of E_u
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
    turn_pll(law, state, (state.omega_pll + law.k_pll * error - m[OMEGA]) * law.half_turn)


@inlined
def turn_pll(law, state, h):
    """The PLL's phasor a tick later, turned by the angle whose half has the tangent h."""
    cosine, sine = state.pll[0], state.pll[1]
    # times (1 + j h) / (1 - j h), whose modulus is 1; the root takes the rounding out
    a, b = law.one - h * h, h + h
    turned_d, turned_q = a * cosine - b * sine, a * sine + b * cosine
    length = math.sqrt(turned_d * turned_d + turned_q * turned_q)
    state.pll[0], state.pll[1] = turned_d / length, turned_q / length


@inlined
def limit_power(law, state, p):
    """omega_u lowered while p is above P_max and raised while it is below P_min, p.u."""
    over, under = p - law.P_max, law.P_min - p
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
def keep_q(law, state, most):
    """i* cut to I_max, whose square is ``most``, with what i_q* leaves for i_d*."""
    q = limited(state.i_ref[1], -law.I_max, law.I_max)
    rest = math.sqrt(most - q * q)
    state.i_ref[0], state.i_ref[1] = limited(state.i_ref[0], -rest, rest), q


@inlined
def limit_current(law, state):
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
        keep_q(law, state, most)
    else:
        scale = law.I_max / math.sqrt(size)
        state.i_ref[0], state.i_ref[1] = d * scale, q * scale


@inlined
def current_loop(law, state):
    """One tick of the current loop: e from i* - i, before the limit of modulation."""
    m, X = state.m, state.omega * law.L_f
    error_d, error_q = state.i_ref[0] - m[I_D], state.i_ref[1] - m[I_Q]
    state.e_now[0] = state.v_f[0] + law.k_c * error_d + state.x_c[0] - X * m[I_Q]
    state.e_now[1] = state.v_f[1] + law.k_c * error_q + state.x_c[1] + X * m[I_D]
    state.x_c[0] += law.T_k_ci * error_d
    state.x_c[1] += law.T_k_ci * error_q


@inlined
def follow(law, state):
    """One tick of the low-passes on v and i."""
    m = state.m
    for k in range(2):
        state.v_f[k] += law.follow_v * (m[V_D + k] - state.v_f[k])
        state.i_f[k] += law.follow_i * (m[I_D + k] - state.i_f[k])
