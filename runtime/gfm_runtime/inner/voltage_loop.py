"""Cascaded loops, and the same behind a threshold impedance.

* ``cascaded``: a PI voltage loop around v* = E - (R_v + j omega X_v) i_o gives i*, which the limit
  cuts, then the current loop;
* ``threshold-impedance``: as ``cascaded``, and beyond the threshold v* falls by
  k_thr (|i_f| - I_thr) (1 + j omega sigma) i_f besides, where i_f is the low-pass filtered current.

Sources: Yazdani and Iravani, "Voltage-Sourced Converters in Power Systems", chapter 8: cascaded
loops; Qoria et al., IEEE Open Access J. Power Energy 7, 2020: threshold virtual impedance, X/R 5,
0.67 p.u.
"""

import math
from typing import Literal

from pydantic import Field

from gfm_runtime.compiled import inlined
from gfm_runtime.inner.stage import I_OD, I_OQ, V_D, V_Q, InnerStage, limit_current
from gfm_runtime.toml_file import NotNegative, Positive


class _VoltageLoop(InnerStage):
    R_v: NotNegative = Field(0.1, description="virtual resistance, p.u.")
    X_v: NotNegative = Field(0.3, description="virtual reactance, p.u.; without states")
    k_v: NotNegative = Field(1.0, description="voltage loop, p.u./p.u.")
    k_vi: NotNegative = Field(100.0, description="voltage loop, 1/s")
    k_ff: NotNegative = Field(0.6, description="part of i_o that is fed forward")
    C_f: NotNegative = Field(0.2268, description="the converter's filter capacitor, p.u.")

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        own = {name: getattr(self, name) for name in ("R_v", "X_v", "k_v", "k_ff", "C_f")}
        return super().constants(T_s, omega_b) | own | {"T_k_vi": T_s * self.k_vi}

    def voltage_drop(self, i: complex, i_o: complex, i_ref: complex, omega: float) -> complex:
        return complex(self.R_v, omega * self.X_v) * i_o


class Cascaded(_VoltageLoop):
    """A voltage loop, a limit, and a current loop."""

    type: Literal["cascaded"] = Field("cascaded", description="kind of stage")


class ThresholdImpedance(_VoltageLoop):
    """The cascaded loops behind a virtual impedance that grows beyond a threshold of current."""

    type: Literal["threshold-impedance"] = Field("threshold-impedance", description="kind of stage")
    I_thr: Positive = Field(1.0, description="threshold, p.u.")
    k_thr: NotNegative = Field(0.67, description="impedance per current beyond the threshold, p.u.")
    sigma: NotNegative = Field(2.0, description="X/R of that impedance")
    f_i: Positive = Field(10.0, description="low-pass on i, Hz")

    def constants(self, T_s: float, omega_b: float) -> dict[str, float]:
        own = {name: getattr(self, name) for name in ("I_thr", "k_thr", "sigma")}
        follow_i = -math.expm1(-2 * math.pi * self.f_i * T_s)
        return super().constants(T_s, omega_b) | own | {"follow_i": follow_i}

    def voltage_drop(self, i: complex, i_o: complex, i_ref: complex, omega: float) -> complex:
        beyond = max(abs(i) - self.I_thr, 0.0)
        return (
            super().voltage_drop(i, i_o, i_ref, omega)
            + self.k_thr * beyond * complex(1.0, omega * self.sigma) * i
        )


@inlined
def drop(law, state):
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
def voltage_loop(law, state, E_d, E_q):
    """One tick of the cascaded voltage loop: i* from v* - v; it integrates only within the
    limit."""
    m, X = state.m, state.omega * law.X_v
    drop(law, state)
    E_d -= state.drop[0]
    E_q -= state.drop[1]
    error_d = E_d - law.R_v * m[I_OD] + X * m[I_OQ] - m[V_D]
    error_q = E_q - law.R_v * m[I_OQ] - X * m[I_OD] - m[V_Q]
    B = state.omega * law.C_f
    state.i_ref[0] = law.k_v * error_d + state.x_v[0] + law.k_ff * m[I_OD] - B * m[V_Q]
    state.i_ref[1] = law.k_v * error_q + state.x_v[1] + law.k_ff * m[I_OQ] + B * m[V_D]
    limit_current(law, state)
    if not state.limited:
        state.x_v[0] += law.T_k_vi * error_d
        state.x_v[1] += law.T_k_vi * error_q
    state.limited = state.limited != 0 or state.drop[0] != 0 or state.drop[1] != 0


@inlined
def settle_voltage_loop(law, state):
    """The integral with which i* is what ``state.i_ref`` holds; returns the current through the
    virtual impedance, i_o."""
    m = state.m
    drop(law, state)
    B = state.omega * law.C_f
    state.x_v[0] = state.i_ref[0] - law.k_ff * m[I_OD] + B * m[V_Q]
    state.x_v[1] = state.i_ref[1] - law.k_ff * m[I_OQ] - B * m[V_D]
    return m[I_OD], m[I_OQ]
