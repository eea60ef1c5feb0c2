"""The exact solution of the circuit between two commands, and the DC link and sensors along it.

While a command is held every source is a phasor of constant length that turns at a constant speed
Omega in the common frame. A mode z' = lambda z + b s then goes in a time h to

    z(h) = e^(lambda h) z(0) + b s(0) (e^(j Omega h) - e^(lambda h)) / (j Omega - lambda),

which is exact to rounding, however fast the mode is. The DC links and the sensors see a parabola
through the quantities at the beginning, the middle and the end of a piece of time: Simpson's
rule, whose error falls with the fourth power of the length. Complex numbers are pairs of reals:
the compiled code is quicker that way.
"""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.records import BLOCKED, FAULTED, OPERATING
from gfm_runtime.compiled import compiled

STATES = ("i_f", "v", "i_o", "i_load", "i_g")
"""The names of w: currents of filter, line and local load; v is the filter capacitor's voltage, and
i_g the current of the line's far piece, if the line has a place for a fault."""
I_F, V, I_O, I_LOAD, I_G = 0, 1, 2, 3, 4
BRIDGE, GRID, NEGATIVE = 0, 1, 2
"""Places of the sources: the grid has one for each sequence of an unbalanced voltage."""


@compiled
def turned(x: float) -> tuple[float, float]:
    """Return cos x and sin x; by their series where they are exact to rounding."""
    if abs(x) < 0.03:
        x2 = x * x
        return (
            1 - x2 * (1 / 2 - x2 * (1 / 24 - x2 * (1 / 720 - x2 / 40320))),
            x * (1 - x2 * (1 / 6 - x2 * (1 / 120 - x2 * (1 / 5040 - x2 / 362880)))),
        )
    return math.cos(x), math.sin(x)


@compiled
def drive(
    r: Any, s: Any, c: int, part: int, k: int, E_r: float, E_i: float, omega: float
) -> tuple[float, float]:
    """Add to the forcing of every mode what source k does to it, and turn its phasor.

    Returns the unit phasor in the middle of the piece.

    Args:
        c: the circuit in force.
        part: which stretch of the period, in which a piece lasts twice ``half_h[part]``.
        E_r, E_i: the source's voltage over its unit phasor, p.u.
        omega: its speed, p.u.; negative for a negative sequence.
    """
    if s.gain_omega[k] != omega or s.gain_part[k] != part:
        _find_gains(r, s, c, part, k, omega)
    cos, sin = s.turn[k, 0], s.turn[k, 1]
    s_r = E_r * s.unit[k, 0] - E_i * s.unit[k, 1]
    s_i = E_r * s.unit[k, 1] + E_i * s.unit[k, 0]
    for m in range(r.n_modes[c]):
        g_r, g_i = s.gain[k, m, 0], s.gain[k, m, 1]
        f_r, f_i = g_r * s_r - g_i * s_i, g_r * s_i + g_i * s_r
        s.forced[m, 0] += f_r
        s.forced[m, 1] += f_i
        s.forced[m, 2] += f_r * cos - f_i * sin
        s.forced[m, 3] += f_r * sin + f_i * cos
    u_r, u_i = s.unit[k, 0], s.unit[k, 1]
    h_r, h_i = u_r * cos - u_i * sin, u_r * sin + u_i * cos
    u_r, u_i = h_r * cos - h_i * sin, h_r * sin + h_i * cos
    length = 1.5 - 0.5 * (u_r * u_r + u_i * u_i)  # takes the rounding out of it
    s.unit[k, 0], s.unit[k, 1] = u_r * length, u_i * length
    return h_r, h_i


@compiled
def _find_gains(r: Any, s: Any, c: int, part: int, k: int, omega: float) -> None:
    """Find what source k does to each mode in half a piece, per unit of its voltage; this stays
    the same while its speed does, as that of an ideal grid."""
    speed = r.omega_b * (omega - 1.0)
    cos, sin = turned(speed * r.half_h[part])
    for m in range(r.n_modes[c]):
        d_r, d_i = -r.rate[c, m, 0], speed - r.rate[c, m, 1]
        n_r, n_i = cos - r.decay[c, part, m, 0], sin - r.decay[c, part, m, 1]
        size = d_r * d_r + d_i * d_i
        h = r.half_h[part]
        if size * h * h > 1e-8:
            g_r, g_i = (n_r * d_r + n_i * d_i) / size, (n_i * d_r - n_r * d_i) / size
        else:  # nearly the mode's own frequency: h e^(lambda h) (1 + z/2 + z^2/6), z = d h
            z_r, z_i = d_r * h, d_i * h
            f_r = 1.0 + z_r / 2.0 + (z_r * z_r - z_i * z_i) / 6.0
            f_i = z_i / 2.0 + z_r * z_i / 3.0
            a_r, a_i = h * r.decay[c, part, m, 0], h * r.decay[c, part, m, 1]
            g_r, g_i = a_r * f_r - a_i * f_i, a_r * f_i + a_i * f_r
        b_r, b_i = r.drive[c, m, k, 0], r.drive[c, m, k, 1]
        s.gain[k, m, 0], s.gain[k, m, 1] = g_r * b_r - g_i * b_i, g_r * b_i + g_i * b_r
    s.turn[k, 0], s.turn[k, 1] = cos, sin
    s.gain_omega[k], s.gain_part[k] = omega, part


@compiled
def half_step(r: Any, s: Any, c: int, part: int, which: int) -> None:
    """Take the modes on by half a piece: ``which`` is 0 for its first half, 2 for its second."""
    for m in range(r.n_modes[c]):
        a_r, a_i = r.decay[c, part, m, 0], r.decay[c, part, m, 1]
        z_r, z_i = s.z[m, 0], s.z[m, 1]
        s.z[m, 0] = a_r * z_r - a_i * z_i + s.forced[m, which]
        s.z[m, 1] = a_r * z_i + a_i * z_r + s.forced[m, which + 1]


@compiled
def state(r: Any, s: Any, c: int, i: int) -> tuple[float, float]:
    """Return state i of w, by the modes."""
    w_r = w_i = 0.0
    for m in range(r.n_modes[c]):
        w_r += r.states[c, i, m, 0] * s.z[m, 0] - r.states[c, i, m, 1] * s.z[m, 1]
        w_i += r.states[c, i, m, 0] * s.z[m, 1] + r.states[c, i, m, 1] * s.z[m, 0]
    return w_r, w_i


@compiled
def read_states(r: Any, s: Any, c: int) -> None:
    """Write all states of w by the modes."""
    for i in range(r.n_states):
        s.w[i, 0], s.w[i, 1] = state(r, s, c, i)


@compiled
def circuit(s: Any) -> int:
    """Return which circuit is in force."""
    return (BLOCKED if s.trip else OPERATING) + (FAULTED if s.faulted else 0)


@compiled
def enter(r: Any, s: Any, c: int) -> None:
    """Start the modes of circuit c from w, which is projected onto what that circuit can hold."""
    for k in range(len(s.gain_part)):
        s.gain_part[k] = -1
    for m in range(r.n_modes[c]):
        z_r = z_i = 0.0
        for i in range(r.n_states):
            z_r += r.modes[c, m, i, 0] * s.w[i, 0] - r.modes[c, m, i, 1] * s.w[i, 1]
            z_i += r.modes[c, m, i, 0] * s.w[i, 1] + r.modes[c, m, i, 1] * s.w[i, 0]
        s.z[m, 0], s.z[m, 1] = z_r, z_i
    read_states(r, s, c)
