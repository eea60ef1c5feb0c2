"""Case 8 by the equations of PowerSimulationsDynamics.jl, without gfmhil: a yardstick.

The equations are those of commit d94d74e7d for VirtualInertia, ReactivePowerDroop, KauraPLL,
VoltageModeControl and LCLFilter, the values those of test/data_tests. An infinite bus lies behind
the filter's second choke and the case's line.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

OMEGA_B = 2 * np.pi * 60.0  # rad/s
L_F, R_F, C_F, L_G, R_G = 0.08, 0.003, 0.074, 0.2 + 0.075 * 2.75 / 100, 0.01  # p.u.
V_G, V_REF, Q_REF = 1.00001, 1.0229159796123373, 0.04541511590746641
T_A, K_D, K_OMEGA, K_Q, OMEGA_Q = 2.0, 400.0, 20.0, 0.2, 1000.0
K_V, K_VI, X_V, K_C, K_CI, OMEGA_AD = 0.59, 736.0, 0.2, 1.27, 14.3, 50.0
BEFORE, AFTER = 0.502500210597563, 0.7  # P_ref, p.u.
N_REAL, N_COMPLEX = 5, 7


class Variant(NamedTuple):
    """A PLL with a frequency of 1 + k_p angle + k_i (integral of the angle), and what else differs.

    Attributes:
        k_p, k_i: of the PLL, p.u.
        omega_lp: of the low-pass before its angle, rad/s; None for none.
        handed_on: what stands for k_p in the frequency that the law reads.
        k_ad: of the active damping.
        k_ff: part of the voltage that is fed forward.
    """

    k_p: float
    k_i: float
    omega_lp: float | None
    handed_on: float
    k_ad: float
    k_ff: float


#: as published; the same, but the law reads the integral alone; and as gfmhil has it
THEIRS = Variant(0.084, 4.69, 500.0, 0.084, 0.2, 0.0)
INTEGRAL_ALONE = THEIRS._replace(handed_on=0.0)
_OMEGA_N = 2 * np.pi * 6.692  # f_pll of psid_vsm.toml, damped by 1/sqrt(2)
OURS = Variant(np.sqrt(2) * _OMEGA_N / OMEGA_B, _OMEGA_N**2 / OMEGA_B, None, 0.0, 0.0, 1.0)


def rates(x: Any, P_ref: float, of: Variant) -> Any:
    """d/dt of the 19 states; the last 14 are real and imaginary parts of 7 complex ones."""
    theta, omega, q_m, integral, theta_pll = x[:N_REAL]
    v_int, i_int, v_ad, v_pll, i, v, i_o = x[N_REAL:].reshape(N_COMPLEX, 2) @ [1.0, 1j]
    to_frame = np.exp(-1j * theta)
    v_f, i_f, i_of, s = v * to_frame, i * to_frame, i_o * to_frame, v * np.conj(i_o)
    v_seen = v * np.exp(-1j * theta_pll)
    angle = np.angle(v_seen if of.omega_lp is None else v_pll)
    omega_law = 1.0 + of.handed_on * angle + of.k_i * integral
    v_off = V_REF + K_Q * (Q_REF - q_m) - 1j * omega * X_V * i_of - v_f
    i_off = K_V * v_off + K_VI * v_int + 1j * C_F * omega * v_f - i_f
    e = K_C * i_off + K_CI * i_int + 1j * omega * L_F * i_f
    e += of.k_ff * v_f - of.k_ad * (v_f - v_ad)
    of_reals = [
        OMEGA_B * (omega - 1.0),
        (P_ref - s.real - K_D * (omega - omega_law) - K_OMEGA * (omega - 1.0)) / T_A,
        OMEGA_Q * (s.imag - q_m),
        angle,
        OMEGA_B * (of.k_p * angle + of.k_i * integral),
    ]
    of_complex = np.array([
        v_off,
        i_off,
        OMEGA_AD * (v_f - v_ad),
        (of.omega_lp or OMEGA_B) * (v_seen - v_pll),
        OMEGA_B / L_F * (e / to_frame - v - (R_F + 1j * L_F) * i),
        OMEGA_B / C_F * (i - i_o - 1j * C_F * v),
        OMEGA_B / L_G * (v - V_G - (R_G + 1j * L_G) * i_o),
    ])  # fmt: skip
    return np.concatenate([of_reals, of_complex.view(float)])


def at_rest(of: Variant) -> Any:
    """The states before the step."""
    start = np.zeros(N_REAL + 2 * N_COMPLEX)
    start[[0, 4]], start[1], start[[11, 15]], start[[13, 17]] = 0.2, 1.0, 1.0, 0.5
    return fsolve(rates, start, (BEFORE, of), xtol=1e-13)


def omega(t: Any, of: Variant) -> Any:
    """The virtual machine's speed, p.u., at t >= 0 seconds after the step of P_ref."""
    found = solve_ivp(
        lambda _, x: rates(x, AFTER, of), (0.0, t[-1]), at_rest(of), "DOP853", t,
        rtol=1e-8, atol=1e-11,
    )  # fmt: skip
    return found.y[1]
