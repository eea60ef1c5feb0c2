"""Dynawo's three grid-forming converters by Dynawo's equations, without gfmhil: a yardstick.

The equations are those of Converter, CurrentLoop, VoltageLoop, VirtualImpedance, DroopControl,
DispatchableVirtualOscillatorControl and MatchingControl in dynawo/dynawo, which its authors'
nrt/data/GridFormingConverters puts together; the values those of GridForming.mo, whose start is
that of the published curves. Variants show one by one what gfmhil has differently.
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
N_STATES, N_BRANCHES = 15, 8


class Variant(NamedTuple):
    """What may differ from what Dynawo has.

    Attributes:
        twice: dVOC gives its voltage the angle of its frame, within that frame.
        by_v_dc: the bridge's voltage rises with v_dc.
        of_square: the virtual impedance sees |i|^2 - 1, else 2 (|i| - 1).
        static: the lines are impedances at the nominal frequency, else inductances, and the
            short circuit is a resistance of the same size.
    """

    twice: bool
    by_v_dc: bool
    of_square: bool
    static: bool


THEIRS = Variant(True, True, True, True)
ONCE = THEIRS._replace(twice=False)
OUR_CONTROL = Variant(False, False, False, True)
OURS = OUR_CONTROL._replace(static=False)


class Circuit(NamedTuple):
    """Transformers of the converters, lines and buses 2, 3, 1 and 4 between two events.

    Attributes:
        z: voltages of the buses over the currents of the transformers into them, p.u., (4, 3), if
            the lines are static.
        into: 1 where a branch leads into a bus, -1 where it leaves one, (4, 8).
        x, r: of the branches, p.u., (8,).
        g: conductances from the buses to earth, p.u., (4,).
    """

    z: Any
    into: Any
    x: Any
    r: Any
    g: Any


def circuit(closed: bool, faulted: bool) -> Circuit:
    """The circuit with and without the line that opens and the short circuit."""
    into = np.zeros((4, N_BRANCHES))
    into[range(3), range(3)] = 1.0
    for k, (a, b) in enumerate(LINES, 3):
        if closed or (a, b) != OPENED:
            into[[b, a], [k, k]] = 1.0, -1.0
    z = np.append((R_T + 1j * X_T) / S, list(LINES.values()))
    lines = into[:, 3:]
    y = lines @ np.diag(1 / z[3:]) @ lines.T + np.diag([LOAD, 0, 0, faulted / FAULT])
    g = np.array([LOAD, 0.0, 0.0, faulted / abs(FAULT)])
    return Circuit(np.linalg.inv(y)[:, :3], into, z.imag, z.real, g)


def buses(i: Any, e: Any, omega: float, at: Circuit) -> Any:
    """Voltages of the buses, p.u.: on the load and the fault by the current into them, elsewhere
    such that the currents' rates sum up to zero.

    Args:
        i: of the branches, p.u.
        e: at the converters' side of the transformers, p.u.; 0 for lines.
        omega: of the frame, p.u.
    """
    free = at.g == 0
    v = np.zeros(4, complex)
    v[~free] = (at.into[~free] @ i) / at.g[~free]
    own = at.into[free] / at.x
    v[free] = np.linalg.solve(
        own @ at.into[free].T, own @ (e - at.into.T @ v - (at.r + 1j * omega * at.x) * i)
    )
    return v


def switch(x: Any, at: Circuit) -> None:
    """Bring the currents to what they are right after an event: an impulse of voltage at the buses
    without a load, whose currents sum up to zero at once, keeps the flux of each mesh."""
    own, lines = x[: 3 * N_STATES].reshape(3, N_STATES), x[-2 * len(LINES) :].view(complex)
    frame = S * np.exp(1j * own[:, 13])
    i = np.append((own[:, 0] + 1j * own[:, 1]) * frame, lines) * at.into.any(axis=0)
    free = at.into[at.g == 0]
    i -= free.T @ np.linalg.solve(free / at.x @ free.T, free @ i) / at.x
    own[:, 0], own[:, 1] = (i[:3] / frame).real, (i[:3] / frame).imag
    lines[:] = i[3:]


def frequencies(power: Any, v_dc: Any, droop: Any) -> Any:
    """Of the three converters, p.u."""
    dvoc = 1 + ETA / OMEGA_B * (P_REF[1] - power[1]) / V_REF[1] ** 2
    return np.array([1 + droop, dvoc, 1 + v_dc[2] - V_REF[2]])


def rates(x: Any, at: Circuit, of: Variant) -> Any:
    """d/dt of the states, in a frame that turns with the matching control."""
    lines, x = x[-2 * len(LINES) :].view(complex), x[: 3 * N_STATES].reshape(3, N_STATES)
    i_o, i, v, v_int, i_int, damped = (x[:, k] + 1j * x[:, k + 1] for k in range(0, 12, 2))
    v_dc, theta, droop = x[:, 12], x[:, 13], x[0, 14]
    power = (v * i_o.conj()).real
    omega = frequencies(power, v_dc, droop)
    frame = np.exp(1j * theta)
    into = i_o * frame * S
    if of.static:
        bus, change = at.z @ into, 0 * lines
    else:
        whole = np.append(into, lines)
        bus = buses(whole, np.append(v * frame, 0 * lines), omega[2], at)
        drop = -at.into.T @ bus - (at.r + 1j * omega[2] * at.x) * whole
        change = np.where(at.into.any(axis=0), OMEGA_B / at.x * drop, 0)[3:]
    bus = bus[:3] / frame
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
    own = np.concatenate([rows.view(float).reshape(3, 12), real], axis=1)
    return np.append(own.ravel(), change.view(float))


def solved(t: Any, of: Variant) -> tuple[Any, Any]:
    """Frequencies and currents of droop, dVOC and matching control, p.u., shape (3, len(t)).

    Args:
        t: increasing instants from the scenario's start, at most 2.5 s; the system rests at 0.
        of: the equations.
    """
    x = np.zeros((3, N_STATES))
    x[:, 0] = x[:, 2] = 0.6
    x[:, 4], x[:, 12], x[:, 13] = 1.01, V_REF, [-0.03, 0.0, 0.02]
    x = np.append(x.ravel(), np.zeros(2 * len(LINES)))
    found = []
    for start, end, closed, faulted in SEGMENTS:
        now = circuit(closed, faulted)
        if not of.static:
            switch(x, now)
        at = np.append(t[(t >= start) & (t < end)], end)
        result = solve_ivp(lambda _, x, now=now: rates(x, now, of), (start, end), x, "LSODA", at,
                           rtol=1e-6, atol=1e-8)  # fmt: skip
        x = result.y[:, -1].copy()
        found.append(result.y[: 3 * N_STATES, :-1])
    y = np.concatenate(found, axis=1).reshape(3, N_STATES, -1)
    i_o, i, v = (y[:, k] + 1j * y[:, k + 1] for k in (0, 2, 4))
    return frequencies((v * i_o.conj()).real, y[:, 12], y[0, 14]), np.abs(i)
