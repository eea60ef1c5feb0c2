"""Stiff source behind an impedance: the limits of WECC's REGFM_A1 and REGFM_B1.

The converter's filter is the source impedance R_e + j X_L, so that the bridge produces the law's E
itself, and I = (E - v) / (R_e + j X_L) flows. While |I| > I_max, the bridge produces
v + I* (R_e + j X_L) with the limited I*.

* E stays within [E_min, E_max]; Q_f beyond [Qmin, Qmax] moves the reference of V through a PI, and
  so E through the law's kpv + kiv/s. Both move the slowest state of the law's E_u row, which is the
  integrator of kiv: give the law limits of E_u that are no narrower, and T_t of one sample.
* The power limiter acts on P_f.
* With ImaxSS > 0 the angle of E against the PLL's stays in a window, whose ends move by
  kI (I_dmaxSS - I_d) within [0, asin(X_L ImaxSS)] and by kI (-Ke I_dmaxSS - I_d) within
  [-asin(X_L ImaxSS), 0], and E in sqrt((V_f -+ I_qmaxSS X_L)^2 + (I_d X_L)^2). While the window
  does not act, the PLL has no effect. PQFlag 1: I_d gets kf ImaxSS, I_q the rest; 0: the reverse.

Sources: PNNL-32278 (REGFM_A1), PNNL-35110 (REGFM_B1), the names of whose parameters these are.
"""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import (
    I_OD,
    I_OQ,
    OMEGA,
    V_D,
    V_Q,
    InnerStage,
    P,
    limit_current,
    limited,
    turn_pll,
)
from gfm_runtime.toml_file import NotNegative, Number, Positive

_RETURN = 0.25  # of what the angle is from an end of its window, at most in a tick
_LEAST_V = 1e-3  # p.u.; below, there is no angle of V for I_d


class StiffSource(InnerStage):
    """E behind the filter's impedance, limits of E, Q and |I|, and windows of angle and voltage."""

    type: Literal["stiff-source"] = Field("stiff-source", description="kind of stage")
    R_e: NotNegative = Field(0.03, description="resistance of the filter, p.u.")
    X_L: Positive = Field(0.15, description="reactance of the filter, p.u.")
    TPf: NotNegative = Field(0.01, description="low-pass on P for the power limiter, s")
    TQf: NotNegative = Field(0.01, description="low-pass on Q for its limits, s")
    TVf: NotNegative = Field(0.0, description="low-pass on V for the window of E, s")
    TIf: NotNegative = Field(0.0, description="low-pass on I_d for the windows, s")
    E_max: Positive = Field(1.5, description="p.u.")
    E_min: NotNegative = Field(0.0, description="p.u.")
    kpv: NotNegative = Field(0.0, description="from V to E, as in the law, p.u./p.u.")
    kiv: NotNegative = Field(0.0, description="from V to E, as in the law, 1/s")
    Qmax: Number = Field(10.0, description="p.u.")
    Qmin: Number = Field(-10.0, description="p.u.")
    kpqmax: NotNegative = Field(3.0, description="of the limits of Q, p.u. of V per p.u.")
    kiqmax: NotNegative = Field(20.0, description="of the limits of Q, 1/s")
    ImaxSS: NotNegative = Field(0.0, description="current that the windows keep, p.u.; 0: none")
    PQFlag: Literal[0, 1] = Field(1, description="1: active current first; 0: reactive current")
    kf: Positive = Field(0.9, description="of ImaxSS, what comes first")
    kI: NotNegative = Field(2.0, description="of the ends of the angle's window, rad/s per p.u.")
    Ke: NotNegative = Field(1.0, description="1: charges as it discharges; 0: does not charge")
    kpPLL: NotNegative = Field(0.265, description="PLL, p.u. of frequency per p.u. of voltage")
    kiPLL: NotNegative = Field(2.65, description="PLL, 1/s")
    DwPLLmax: Positive = Field(0.2, description="limit of the PLL's deviation, p.u.")
    VPLLfrz: NotNegative = Field(0.05, description="voltage below which the PLL is frozen, p.u.")

    @model_validator(mode="after")
    def _ascending(self) -> StiffSource:
        for low, high in (("Qmin", "Qmax"), ("E_min", "E_max")):
            ends = getattr(self, low), getattr(self, high)
            if all(isinstance(end, float) for end in ends) and not ends[0] < ends[1]:
                raise ValueError(f"{high} = {ends[1]!r} must be above {low} = {ends[0]!r}")
        return self

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        def follow(T: float) -> float:
            return -math.expm1(-T_s / T) if T > 0.0 else 1.0

        Y, first = 1.0 / complex(self.R_e, self.X_L), self.kf * self.ImaxSS
        return super().constants(T_s, omega_b) | {
            "R_e": self.R_e,
            "X_L": self.X_L,
            "G_e": Y.real,
            "B_e": -Y.imag,
            "follow_P": follow(self.TPf),
            "follow_Q": follow(self.TQf),
            "follow_V": follow(self.TVf),
            "follow_I": follow(self.TIf),
            "E_max": self.E_max,
            "E_min": self.E_min,
            "kpv": self.kpv,
            "T_kiv": T_s * self.kiv,
            "Q_max": self.Qmax,
            "Q_min": self.Qmin,
            "k_Q": self.kpqmax,
            "T_k_Qi": T_s * self.kiqmax,
            "I_ss": self.ImaxSS,
            "I_dss": first if self.PQFlag else 0.0,
            "I_qss": 0.0 if self.PQFlag else first,
            "T_kI": T_s * self.kI,
            "Ke": self.Ke,
            "angle_max": math.asin(min(self.X_L * self.ImaxSS, 1.0)),
            "k_follow": self.kpPLL,
            "T_k_follow": T_s * self.kiPLL,
            "Dw_max": self.DwPLLmax,
            "V_frz": self.VPLLfrz,
            "give_back": _RETURN / (omega_b * T_s),
            "sixth": 1 / 6,
            "v_tiny": _LEAST_V,
        }

    def internal_voltage(
        self, i: complex, v: complex, i_o: complex, e: complex, omega: float
    ) -> complex:
        self.check_current(abs(i))
        return e

    def rests(self, E: float, q: float) -> bool:
        """Whether neither the limits of E nor those of q act there, p.u.; the windows are not
        looked at."""
        return self.E_min <= E <= self.E_max and self.Qmin <= q <= self.Qmax


@inlined
def follow_powers(law, state):
    """One tick of the low-passes on P, Q, V and I_d."""
    m, v_d, v_q = state.m, state.v_f[0], state.v_f[1]
    q = m[V_Q] * m[I_OD] - m[V_D] * m[I_OQ]
    V = math.sqrt(v_d * v_d + v_q * v_q)
    at_least = max(V, law.v_tiny)
    I_d = (v_d * m[I_OD] + v_q * m[I_OQ]) / at_least
    state.slow[0] += law.follow_P * (m[P] - state.slow[0])
    state.slow[1] += law.follow_Q * (q - state.slow[1])
    state.level[0] += law.follow_V * (V - state.level[0])
    state.level[1] += law.follow_I * (I_d - state.level[1])


@inlined
def rest_of(law, part):
    """What of ImaxSS is left beside ``part``, p.u."""
    rest = law.I_ss * law.I_ss - part * part
    rest = max(rest, law.one - law.one)
    return math.sqrt(rest)


@inlined
def held_voltage(law, state):
    """E from E_u within its limits, p.u.; ``state.push`` is what the law's integrator lacks."""
    over, under = state.slow[1] - law.Q_max, law.Q_min - state.slow[1]
    lower, higher = law.k_Q * over + state.x_Q[0], law.k_Q * under + state.x_Q[1]
    state.push = 0  # of the reference of V at first
    if lower > 0:
        state.push -= lower
    if higher > 0:
        state.push += higher
    low, high = law.E_min, law.E_max
    if law.I_ss > 0:
        I_d = state.level[1]
        I_q = law.I_qss
        if I_q == 0:
            I_q = rest_of(law, I_d)
        X_I, X_q = law.X_L * I_d, law.X_L * I_q
        below, above = state.level[0] - X_q, state.level[0] + X_q
        least, most = math.sqrt(below * below + X_I * X_I), math.sqrt(above * above + X_I * X_I)
        low, high = max(low, least), min(high, most)
    E = state.now[2] + law.kpv * state.push + law.T_kiv * state.push
    inside = limited(E, low, high)
    state.push = law.T_kiv * state.push + (inside - E)
    return inside


@inlined
def move_limits(law, state):
    """One tick of the integrals of the limits of Q."""
    state.x_Q[0] += law.T_k_Qi * (state.slow[1] - law.Q_max)
    if state.x_Q[0] < 0:
        state.x_Q[0] = 0
    state.x_Q[1] += law.T_k_Qi * (law.Q_min - state.slow[1])
    if state.x_Q[1] < 0:
        state.x_Q[1] = 0


@inlined
def keep_angle(law, state):
    """One tick of the PLL and of the angle's window: omega_u such that E stays within it."""
    v_d, v_q = state.v_f[0], state.v_f[1]
    I_d = state.level[1]
    most = law.I_dss
    if most == 0:
        most = rest_of(law, law.I_qss)
    zero = law.one - law.one
    state.window[0] = limited(state.window[0] + law.T_kI * (most - I_d), zero, law.angle_max)
    lowest = state.window[1] - law.T_kI * (law.Ke * most + I_d)
    state.window[1] = limited(lowest, -law.angle_max, zero)
    deviation = state.omega_pll - law.one
    error = zero
    if v_d * v_d + v_q * v_q > law.V_frz * law.V_frz:
        error = v_q * state.pll[0] - v_d * state.pll[1]
        deviation = limited(deviation + law.T_k_follow * error, -law.Dw_max, law.Dw_max)
    state.omega_pll = law.one + deviation
    deviation = limited(deviation + law.k_follow * error, -law.Dw_max, law.Dw_max)
    sine = -state.pll[1]
    if state.pll[0] < 0:  # more than a quarter of a turn away
        sine = law.one
        if state.pll[1] > 0:
            sine = -law.one
    angle = sine + law.sixth * sine * sine * sine  # of E against the PLL, rad, within 1e-5
    low, high = law.give_back * (state.window[1] - angle), law.give_back * (state.window[0] - angle)
    follows = law.one + deviation
    state.omega = limited(state.omega, follows + low, follows + high)
    turn_pll(law, state, (follows - state.m[OMEGA]) * law.half_turn)


@inlined
def stiff_source(law, state):
    """One tick: the bridge's voltage from E_u, and omega_u within the angle's window."""
    v_d, v_q = state.v_f[0], state.v_f[1]
    E_d, E_q = held_voltage(law, state) + state.away[0], state.away[1]
    move_limits(law, state)
    if law.I_ss > 0:
        keep_angle(law, state)
    lack_d, lack_q = E_d - v_d, E_q - v_q
    state.i_ref[0] = law.G_e * lack_d + law.B_e * lack_q
    state.i_ref[1] = law.G_e * lack_q - law.B_e * lack_d
    limit_current(law, state)
    state.e_now[0], state.e_now[1] = E_d, E_q
    if state.limited != 0:
        d, q = state.i_ref[0], state.i_ref[1]
        state.e_now[0] = v_d + law.R_e * d - law.X_L * q
        state.e_now[1] = v_q + law.R_e * q + law.X_L * d
