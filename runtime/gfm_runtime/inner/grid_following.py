"""Grid-following: a current by set-points of P and Q in the frame of a PLL, and the current loop.

With theta and omega the angle and frequency of the PLL, and V the low-pass filtered abs(v), at
least V_least where it divides, the reference of the filter's current is

    i* = (P/V + j (omega C_f V - Q_ref/V - b)) e^(j theta),
    P = P_ref + k_f dead(1 - omega) + (k_dc + k_dci/s) (v_dc - V_dcref),    b = k_V dead(1 - V),

where dead(x) is what x is beyond its dead band: a droop of the power by the frequency, a control of
v_dc for a DC side that does not hold it, such as a PV array straight across the link, and the
reactive current that supports the voltage. While b is not 0, the reactive current has the first
place within I_max. omega_u and E_u of the law do not act: it has row 1 only.

The converter's frame turns with the PLL, and slowly to the angle of v + (R_v + j X_v) i, where the
E of a grid-forming law with such a virtual impedance is, so that each may take over from the other.

Source: Yazdani and Iravani, "Voltage-Sourced Converters in Power Systems", chapter 8.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import I_D, I_Q, V_DC, InnerStage, keep_q, limit_current, limited
from gfm_runtime.toml_file import NotNegative, Positive

_RETURN = 10.0  # 1/s, of the converter's frame to the angle of E


class GridFollowingStage(InnerStage):
    """A current by set-points of P and Q in the frame of a PLL, a limit, and a current loop."""

    rows: ClassVar = (0,)
    references: ClassVar = ("V_dcref", "P_ref", "Q_ref")

    type: Literal["grid-following"] = Field("grid-following", description="kind of stage")
    f_pll: Positive = Field(10.0, description="natural frequency of the PLL, Hz")
    freeze: Literal[False] = Field(False, description="no row of the law acts on the current")
    power: None = Field(
        None, description="none: omega_u, which a power limiter moves, is the PLL's"
    )
    k_ci: NotNegative = Field(5.0, description="current loop, 1/s")
    R_v: NotNegative = Field(0.1, description="virtual resistance of laws that take over, p.u.")
    X_v: NotNegative = Field(0.3, description="virtual reactance of laws that take over, p.u.")
    C_f: NotNegative = Field(0.2268, description="the converter's filter capacitor, p.u.")
    DwPLLmax: Positive = Field(0.2, description="limit of the PLL's deviation, p.u.")
    T_V: Positive = Field(0.005, description="low-pass on abs(v), s")
    V_least: Positive = Field(0.2, description="least V by which P and Q are divided, p.u.")
    k_V: NotNegative = Field(
        0.0, description="reactive current by the voltage beyond the dead band, p.u./p.u."
    )
    band_V: Positive = Field(0.1, description="dead band of V around 1 p.u.")
    k_f: NotNegative = Field(
        0.0, description="power by the frequency beyond the dead band, p.u./p.u."
    )
    band_f: NotNegative = Field(0.0, description="dead band of the frequency around 1 p.u.")
    k_dc: NotNegative = Field(0.0, description="power by v_dc, p.u./p.u.")
    k_dci: NotNegative = Field(0.0, description="power by the integral of v_dc, 1/s")

    @model_validator(mode="before")
    @classmethod
    def _has_no_voltage_to_freeze(cls, content: Any) -> Any:
        if isinstance(content, dict):
            if content.get("power") is not None:
                raise ValueError("power: not with grid-following, whose frequency is the PLL's")
            if content.get("freeze"):
                raise ValueError("freeze: not with grid-following, on which no E_u acts")
        return content

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        own = ("R_v", "X_v", "C_f", "V_least", "k_V", "band_V", "k_f", "band_f", "k_dc")
        return super().constants(T_s, omega_b) | {name: getattr(self, name) for name in own} | {
            "T_k_dci": T_s * self.k_dci,
            "give_back": _RETURN / omega_b,
            "follow_V": -math.expm1(-T_s / self.T_V),
            "Dw_max": self.DwPLLmax,
        }  # fmt: skip

    def internal_voltage(
        self, i: complex, v: complex, i_o: complex, e: complex, omega: float
    ) -> complex:
        self.check_current(abs(self.reference(i, v, e, omega)))
        return v + complex(self.R_v, self.X_v) * i

    def wanted(self, ref: NDArray[np.float64], v_dc: float, V: float, omega: float) -> complex:
        """i* in the PLL's frame before its limit, p.u., at rest at references (5,), v_dc, V and
        omega, p.u.; without an integral of v_dc."""
        P_ref, Q_ref = ref[1], ref[3]
        P = P_ref + self.k_f * beyond.py_func(1.0 - omega, self.band_f)
        P += self.k_dc * (v_dc - ref[0])
        of, b = max(V, self.V_least), self.k_V * beyond.py_func(1.0 - V, self.band_V)
        return complex(P / of, omega * self.C_f * V - Q_ref / of - b)


@inlined
def beyond(x, band):
    """What x is beyond a dead band around 0."""
    return x - limited(x, -band, band)


@inlined
def support(law, state):
    """b, the reactive current that supports the voltage, p.u."""
    return law.k_V * beyond(law.one - state.level[0], law.band_V)


@inlined
def ask_current(law, state):
    """i* in the PLL's frame, not limited, from P_ref and Q_ref at what V and omega are."""
    V = state.level[0]
    of = max(V, law.V_least)
    power = state.ref[1] + law.k_f * beyond(law.one - state.omega_pll, law.band_f)
    power += law.k_dc * (state.m[V_DC] - state.ref[0]) + state.x_v[0]
    state.i_ref[0] = power / of
    state.i_ref[1] = state.omega_pll * law.C_f * V - state.ref[3] / of - support(law, state)


@inlined
def limit_reactive_first(law, state):
    """i* cut to I_max, with what i_q* leaves for i_d*, and whether that was needed."""
    d, q = state.i_ref[0], state.i_ref[1]
    most = law.I_max * law.I_max
    state.limited = d * d + q * q > most
    if state.limited != 0:
        keep_q(law, state, most)


@inlined
def grid_following(law, state):
    """One tick, after that of the PLL: i*. v_dc is integrated while no limit acts."""
    low, high = law.one - law.Dw_max, law.one + law.Dw_max
    state.omega = state.omega_pll = limited(state.omega_pll, low, high)
    V = math.sqrt(state.v_f[0] * state.v_f[0] + state.v_f[1] * state.v_f[1])
    state.level[0] += law.follow_V * (V - state.level[0])
    ask_current(law, state)
    state.i_ref[0] += state.away[0]
    state.i_ref[1] += state.away[1]
    if support(law, state) == 0:
        limit_current(law, state)
    else:
        limit_reactive_first(law, state)
    if state.limited == 0:
        state.x_v[0] += law.T_k_dci * (state.m[V_DC] - state.ref[0])
    d, q, cosine, sine = state.i_ref[0], state.i_ref[1], state.pll[0], state.pll[1]
    state.i_ref[0], state.i_ref[1] = cosine * d - sine * q, cosine * q + sine * d


@inlined
def turn_frame(law, state):
    """omega_u, with which the frame turns with the PLL and slowly to the angle of E."""
    E_d = state.v_f[0] + law.R_v * state.m[I_D] - law.X_v * state.m[I_Q]
    E_q = state.v_f[1] + law.R_v * state.m[I_Q] + law.X_v * state.m[I_D]
    E = math.sqrt(E_d * E_d + E_q * E_q)
    E = max(E, law.least_v)
    low, high = law.one - law.Dw_max, law.one + law.Dw_max
    state.omega = limited(state.omega_pll + law.give_back * (E_q / E), low, high)


@inlined
def settle_following(law, state):
    """Into away what i* lacks of the current that ``state.i_ref`` holds."""
    d, q, cosine, sine = state.i_ref[0], state.i_ref[1], state.pll[0], state.pll[1]
    state.x_v[0] = state.x_v[1] = 0
    ask_current(law, state)
    state.away[0] = cosine * d + sine * q - state.i_ref[0]
    if law.T_k_dci > 0:
        of = max(state.level[0], law.V_least)
        state.x_v[0] = state.away[0] * of
        state.away[0] = 0
    state.away[1] = cosine * q - sine * d - state.i_ref[1]
    state.i_ref[0], state.i_ref[1] = d, q
