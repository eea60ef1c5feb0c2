"""The exact solution of the circuit between two commands, and the DC link and sensors along it.

While a command is held every source is a phasor of constant length that turns at a constant speed
Omega in the common frame. A mode z' = lambda z + b s then goes in a time h to

    z(h) = e^(lambda h) z(0) + b s(0) (e^(j Omega h) - e^(lambda h)) / (j Omega - lambda),

which is exact to rounding, however fast the mode is. The DC links and the sensors see a parabola
through the quantities at the beginning, the middle and the end of a piece of time: Simpson's
rule, whose error falls with the fourth power of the length. Complex numbers are pairs of reals:
the compiled code is quicker that way.

The modes of an unbalanced circuit are driven by the sources and by their mirror images
conj(s) e^(-2 j omega_b t), which are phasors too: they turn at -omega where a source turns at
omega. See `circuit.join_axes`.
"""

from __future__ import annotations

import math
from typing import Any

from gfm_plant.records import N_OWN
from gfm_runtime.compiled import compiled, inlined

I_F, V, I_O = 0, 1, 2
"""Places of a converter's states in w, from ``own(k)`` on: currents of filter and line, and the
voltage of the filter capacitor."""


@compiled
def own(k: int) -> int:
    """Return where the states of converter k begin in w. Its source is number k."""
    return N_OWN * k


@compiled
def grid_source(n: Any) -> int:
    """Return the place of the grid's positive sequence; its negative sequence is the next one."""
    return n.n_converters


@compiled
def machine_source(n: Any, j: int) -> int:
    """Return the place of machine j among the sources; the first machine is number 1."""
    return n.n_converters + 1 + j


@compiled
def sink_source(n: Any, j: int) -> int:
    """Return the place among the sources of the current of load j of constant power."""
    return n.n_converters + 2 + n.n_machines + j


@compiled
def turned(x: float) -> tuple[float, float]:
    """Return cos x and sin x; by their series where they are exact to rounding."""
    if abs(x) < 0.03:
        x2 = x * x
        return (
            1 - x2 * (1 / 2 - x2 * (1 / 24 - x2 * (1 / 720 - x2 * (1 / 40320)))),
            x * (1 - x2 * (1 / 6 - x2 * (1 / 120 - x2 * (1 / 5040 - x2 * (1 / 362880))))),
        )
    return math.cos(x), math.sin(x)


@compiled
def mirror_at(n: Any, tick: int) -> tuple[float, float]:
    """Return e^(-2 j omega_b t) at a tick: the mirror image of x is conj(x) times that."""
    angle = -2.0 * n.omega_b * n.T_s * tick
    return math.cos(angle), math.sin(angle)


@compiled
def mirror_sources(n: Any, now: Any, tick: int) -> None:
    """Set the unit phasors of the sources' mirror images."""
    m_r, m_i = mirror_at(n, tick)
    images = len(now.unit) // 2
    for k in range(images):
        u_r, u_i = now.unit[k, 0], now.unit[k, 1]
        now.unit[images + k, 0] = u_r * m_r + u_i * m_i
        now.unit[images + k, 1] = u_r * m_i - u_i * m_r


@compiled
def drive(
    n: Any, now: Any, c: int, part: int, k: int, E_r: float, E_i: float, omega: float
) -> None:
    """Add to the forcing of every mode what source k does to it, in an unbalanced circuit with its
    mirror image, and turn their phasors.

    Args:
        n, now: elements of ``net`` and ``now``, also below.
        c: the circuit in force.
        part: which stretch of the period, in which a piece lasts twice ``half_h[part]``.
        E_r, E_i: the source's voltage over its unit phasor, p.u.
        omega: its speed, p.u.; negative for a negative sequence.
    """
    _drive(n, now, c, part, k, k, E_r, E_i, omega)
    if n.unbalanced[c]:
        _drive(n, now, c, part, len(now.unit) // 2 + k, k, E_r, -E_i, -omega)


@inlined
def _drive(
    n: Any, now: Any, c: int, part: int, k: int, source: int, E_r: float, E_i: float, omega: float
) -> None:
    """Drive by the phasor at place k: that of a source, or its mirror image."""
    if now.gain_omega[part, k] != omega:
        _find_gains(n, now, c, part, k, source, omega)
    cos, sin = now.turn[part, k, 0], now.turn[part, k, 1]
    s_r = E_r * now.unit[k, 0] - E_i * now.unit[k, 1]
    s_i = E_r * now.unit[k, 1] + E_i * now.unit[k, 0]
    for m in range(n.n_modes[c]):
        g_r, g_i = now.gain[part, k, m, 0], now.gain[part, k, m, 1]
        f_r, f_i = g_r * s_r - g_i * s_i, g_r * s_i + g_i * s_r
        now.forced[m, 0] += f_r
        now.forced[m, 1] += f_i
        now.forced[m, 2] += f_r * cos - f_i * sin
        now.forced[m, 3] += f_r * sin + f_i * cos
    _turn_on(now, part, k)


@compiled
def _turn_on(now: Any, part: int, k: int) -> None:
    """Take the phasor at place k on by a piece."""
    cos, sin = now.turn[part, k, 0], now.turn[part, k, 1]
    u_r, u_i = now.unit[k, 0], now.unit[k, 1]
    h_r, h_i = u_r * cos - u_i * sin, u_r * sin + u_i * cos
    now.halfway[k, 0], now.halfway[k, 1] = h_r, h_i
    u_r, u_i = h_r * cos - h_i * sin, h_r * sin + h_i * cos
    length = 1.5 - 0.5 * (u_r * u_r + u_i * u_i)  # takes the rounding out of it
    now.unit[k, 0], now.unit[k, 1] = u_r * length, u_i * length


@compiled
def draw(
    n: Any, now: Any, c: int, part: int, k: int,
    first_r: float, first_i: float, second_r: float, second_i: float,
) -> None:  # fmt: skip
    """Add to the forcing of every mode what source k does to it, which is held at one value in the
    first half of a piece and at another in the second, in the common frame."""
    if now.gain_omega[part, k] != 1.0:
        _find_gains(n, now, c, part, k, k, 1.0)
    _draw(n, now, c, part, k, first_r, first_i, second_r, second_i)
    if n.unbalanced[c]:
        j = len(now.unit) // 2 + k
        if now.gain_omega[part, j] != -1.0:
            _find_gains(n, now, c, part, j, k, -1.0)
        u_r, u_i = now.unit[j, 0], now.unit[j, 1]
        _turn_on(now, part, j)
        h_r, h_i = now.halfway[j, 0], now.halfway[j, 1]
        _draw(
            n, now, c, part, j, first_r * u_r + first_i * u_i, first_r * u_i - first_i * u_r,
            second_r * h_r + second_i * h_i, second_r * h_i - second_i * h_r,
        )  # fmt: skip


@compiled
def _draw(
    n: Any, now: Any, c: int, part: int, k: int,
    first_r: float, first_i: float, second_r: float, second_i: float,
) -> None:  # fmt: skip
    """Drive by two values of the source, or the mirror image, at place k."""
    for m in range(n.n_modes[c]):
        g_r, g_i = now.gain[part, k, m, 0], now.gain[part, k, m, 1]
        now.forced[m, 0] += g_r * first_r - g_i * first_i
        now.forced[m, 1] += g_r * first_i + g_i * first_r
        now.forced[m, 2] += g_r * second_r - g_i * second_i
        now.forced[m, 3] += g_r * second_i + g_i * second_r


@compiled
def _find_gains(n: Any, now: Any, c: int, part: int, k: int, source: int, omega: float) -> None:
    """Find what the phasor at place k, that of a source or its mirror image, does to each mode in
    half a piece, per unit of its voltage; this stays the same while its speed does, as that of an
    ideal grid."""
    speed = n.omega_b * (omega - 1.0)
    cos, sin = turned(speed * n.half_h[part])
    for m in range(n.n_modes[c]):
        d_r, d_i = -n.rate[c, m, 0], speed - n.rate[c, m, 1]
        n_r, n_i = cos - n.decay[c, part, m, 0], sin - n.decay[c, part, m, 1]
        size = d_r * d_r + d_i * d_i
        h = n.half_h[part]
        if size * h * h > 1e-8:
            per_size = 1.0 / size
            g_r, g_i = (n_r * d_r + n_i * d_i) * per_size, (n_i * d_r - n_r * d_i) * per_size
        else:  # nearly the mode's own frequency: h e^(lambda h) (1 + z/2 + z^2/6), z = d h
            z_r, z_i = d_r * h, d_i * h
            f_r = 1.0 + z_r / 2.0 + (z_r * z_r - z_i * z_i) / 6.0
            f_i = z_i / 2.0 + z_r * z_i / 3.0
            a_r, a_i = h * n.decay[c, part, m, 0], h * n.decay[c, part, m, 1]
            g_r, g_i = a_r * f_r - a_i * f_i, a_r * f_i + a_i * f_r
        b_r, b_i = n.drive[c, m, source, 0], n.drive[c, m, source, 1]
        if k != source:
            x_r, x_i = n.mirror[c, m, 0], n.mirror[c, m, 1]
            b_r, b_i = b_r * x_r - b_i * x_i, b_r * x_i + b_i * x_r
        now.gain[part, k, m, 0] = g_r * b_r - g_i * b_i
        now.gain[part, k, m, 1] = g_r * b_i + g_i * b_r
    now.turn[part, k, 0], now.turn[part, k, 1] = cos, sin
    now.gain_omega[part, k] = omega


@inlined
def half_step(n: Any, now: Any, c: int, part: int, which: int) -> None:
    """Take the modes on by half a piece: ``which`` is 0 for its first half, 2 for its second."""
    for m in range(n.n_modes[c]):
        a_r, a_i = n.decay[c, part, m, 0], n.decay[c, part, m, 1]
        z_r, z_i = now.z[m, 0], now.z[m, 1]
        now.z[m, 0] = a_r * z_r - a_i * z_i + now.forced[m, which]
        now.z[m, 1] = a_r * z_i + a_i * z_r + now.forced[m, which + 1]


@inlined
def state(n: Any, now: Any, c: int, i: int) -> tuple[float, float]:
    """Return state i of w, by the modes."""
    w_r = w_i = 0.0
    for m in range(n.n_modes[c]):
        w_r += n.states[c, i, m, 0] * now.z[m, 0] - n.states[c, i, m, 1] * now.z[m, 1]
        w_i += n.states[c, i, m, 0] * now.z[m, 1] + n.states[c, i, m, 1] * now.z[m, 0]
    return w_r, w_i


@compiled
def read_states(n: Any, now: Any, c: int) -> None:
    """Write all states of w by the modes."""
    for i in range(n.n_states):
        now.w[i, 0], now.w[i, 1] = state(n, now, c, i)


@compiled
def circuit(n: Any, now: Any) -> int:
    """Return which circuit is in force."""
    return now.row + (n.n_converters + 1 if now.faulted else 0)


@compiled
def enter(n: Any, now: Any, tick: int, c: int) -> None:
    """Start the modes of circuit c at a tick from w, which is projected onto what that circuit can
    hold."""
    for part in range(len(now.gain_omega)):
        for k in range(len(now.unit)):
            now.gain_omega[part, k] = math.inf
    for m in range(n.n_modes[c]):
        z_r = z_i = 0.0
        for i in range(n.n_states):
            z_r += n.modes[c, m, i, 0] * now.w[i, 0] - n.modes[c, m, i, 1] * now.w[i, 1]
            z_i += n.modes[c, m, i, 0] * now.w[i, 1] + n.modes[c, m, i, 1] * now.w[i, 0]
        now.z[m, 0], now.z[m, 1] = z_r, z_i
    if n.unbalanced[c]:
        m_r, m_i = mirror_at(n, tick)
        for m in range(n.n_modes[c]):
            z_r = z_i = 0.0
            for i in range(n.n_states):
                z_r += n.modes[c, m, i, 0] * now.w[i, 0] + n.modes[c, m, i, 1] * now.w[i, 1]
                z_i += n.modes[c, m, i, 1] * now.w[i, 0] - n.modes[c, m, i, 0] * now.w[i, 1]
            f_r = n.mirror[c, m, 0] * m_r - n.mirror[c, m, 1] * m_i
            f_i = n.mirror[c, m, 0] * m_i + n.mirror[c, m, 1] * m_r
            now.z[m, 0] += z_r * f_r - z_i * f_i
            now.z[m, 1] += z_r * f_i + z_i * f_r
    read_states(n, now, c)
