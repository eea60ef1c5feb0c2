"""Dynawo's three grid-forming converters by Dynawo's equations, without gfmhil: a yardstick.

The equations are those of Converter, CurrentLoop, VoltageLoop, VirtualImpedance, DroopControl,
DispatchableVirtualOscillatorControl and MatchingControl in dynawo/dynawo, which its authors'
nrt/data/GridFormingConverters puts together; the values those of GridForming.mo, whose start is
that of the published curves. Lines are static, so node voltages follow from the currents.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

OMEGA_B = 100 * np.pi  # rad/s
S = np.array([2.5, 5.0, 10.0])  # of droop, dVOC, matching control, in 100 MVA as all of the grid
V_REF = np.array([1.0138, 1.0131, 1.0143])  # also of v_dc
I_REF, P_REF = np.array([0.6153, 0.5958, 0.63]), np.array([0.6238, 0.6036])
L_F, R_F, C_F, X_T, R_T, T_DC = 0.15, 0.005, 0.066, 0.2, 0.01, 0.01
K_V, K_VI, K_C, K_CI, K_DC, K_THR, X_R = 0.52, 1.161022, 0.7388, 1.19, 50.0, 0.67, 5.0
M_P, OMEGA_P, K_FF, OMEGA_FF, ETA = 0.02, 60.0, 0.01, 16.66, 1.0
LOAD, FAULT = 11.25, 0.0001 + 0.001j
LINES = {(2, 0): 0.00075 + 0.0075j, (2, 1): 0.00375 + 0.0375j, (0, 1): 0.003 + 0.03j,
         (0, 3): 0.0015 + 0.015j, (3, 1): 0.0015 + 0.015j}  # fmt: skip
OPENED = (2, 0)
SEGMENTS = [(-12.0, 0.5, True, False), (0.5, 1.5, False, False), (1.5, 1.65, False, True),
            (1.65, 2.6, False, False)]  # from, to [s], whether closed, whether faulted  # fmt: skip
N_STATES = 15


class Variant(NamedTuple):
    """What may differ from what Dynawo has.

    Attributes:
        twice: dVOC gives its voltage the angle of its frame, within that frame.
        by_v_dc: the bridge's voltage rises with v_dc.
        of_square: the virtual impedance sees |i|^2 - 1, else 2 (|i| - 1).
    """

    twice: bool
    by_v_dc: bool
    of_square: bool


THEIRS = Variant(True, True, True)
ONCE = THEIRS._replace(twice=False)
OURS = Variant(False, False, False)


def impedances(closed: bool, faulted: bool) -> Any:
    """Voltages of buses 2, 3, 1 and 4 over the currents into them, p.u."""
    y = np.zeros((4, 4), complex)
    for (a, b), z in LINES.items():
        if closed or (a, b) != OPENED:
            y[[a, b], [a, b]] += 1 / z
            y[[a, b], [b, a]] -= 1 / z
    y[0, 0] += LOAD
    y[3, 3] += faulted / FAULT
    return np.linalg.inv(y)


def frequencies(power: Any, v_dc: Any, droop: Any) -> Any:
    """Of the three converters, p.u."""
    dvoc = 1 + ETA / OMEGA_B * (P_REF[1] - power[1]) / V_REF[1] ** 2
    return np.array([1 + droop, dvoc, 1 + v_dc[2] - V_REF[2]])


def rates(x: Any, z: Any, of: Variant) -> Any:
    """d/dt of the states, in a frame that turns with the matching control."""
    x = x.reshape(3, N_STATES)
    i_o, i, v, v_int, i_int, damped = (x[:, k] + 1j * x[:, k + 1] for k in range(0, 12, 2))
    v_dc, theta, droop = x[:, 12], x[:, 13], x[0, 14]
    power = (v * i_o.conj()).real
    omega = frequencies(power, v_dc, droop)
    frame = np.exp(1j * theta)
    bus = (z @ np.append(i_o * frame * S, 0))[:3] / frame
    over = np.maximum(abs(i) ** 2 - 1 if of.of_square else 2 * (abs(i) - 1), 0.0)
    v_ref = V_REF - K_THR * over * (1 + 1j * X_R) * i
    v_ref[0] -= damped[0]
    if of.twice:
        v_ref[1] += V_REF[1] * (frame[1] - 1)
    v_off = v_ref - v
    i_off = i_o + K_V * v_off + v_int + 1j * omega * C_F * v - i
    e = v + K_C * i_off + i_int + 1j * omega * L_F * i
    if of.by_v_dc:
        e = e * v_dc / V_REF
    rows = np.stack([
        OMEGA_B / X_T * (v - (R_T + 1j * omega * X_T) * i_o - bus),
        OMEGA_B / L_F * (e - (R_F + 1j * omega * L_F) * i - v),
        OMEGA_B / C_F * (i - 1j * omega * C_F * v - i_o),
        K_VI * v_off,
        K_CI * i_off,
        OMEGA_FF * (K_FF * i_o - damped),
    ], axis=1)  # fmt: skip
    i_dc = I_REF + K_DC * (V_REF - v_dc)
    real = np.stack([
        (i_dc - (e * i.conj()).real / v_dc) / T_DC,
        OMEGA_B * (omega - omega[2]),
        np.full(3, OMEGA_P * (M_P * (P_REF[0] - power[0]) - droop)),
    ], axis=1)  # fmt: skip
    return np.concatenate([rows.view(float).reshape(3, 12), real], axis=1).ravel()


def solved(t: Any, of: Variant) -> tuple[Any, Any]:
    """Frequencies and currents of droop, dVOC and matching control, p.u., shape (3, len(t)).

    Args:
        t: increasing instants from the scenario's start, at most 2.5 s; the system rests at 0.
        of: the equations.
    """
    x = np.zeros((3, N_STATES))
    x[:, 0] = x[:, 2] = 0.6
    x[:, 4], x[:, 12], x[:, 13] = 1.01, V_REF, [-0.03, 0.0, 0.02]
    x = x.ravel()
    found = []
    for start, end, closed, faulted in SEGMENTS:
        z = impedances(closed, faulted)
        at = np.append(t[(t >= start) & (t < end)], end)
        result = solve_ivp(lambda _, x, z=z: rates(x, z, of), (start, end), x, "LSODA", at,
                           rtol=1e-8, atol=1e-10)  # fmt: skip
        x = result.y[:, -1]
        found.append(result.y[:, :-1])
    y = np.concatenate(found, axis=1).reshape(3, N_STATES, -1)
    i_o, i, v = (y[:, k] + 1j * y[:, k + 1] for k in (0, 2, 4))
    return frequencies((v * i_o.conj()).real, y[:, 12], y[0, 14]), np.abs(i)
