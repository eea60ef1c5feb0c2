"""Loads of constant power: the current that their control draws, along a piece of time.

The load measures the voltage v of its node as v_f, a space vector in the common frame, with a lag:

    tau dv_f/dt = v - v_f,    i = conj(S) v_f / max(|v_f|^2, V_least^2)

so that i = conj(S / v_f) while |v_f| is above V_least, and below it the load is an impedance, as
the constant-power loads of transmission programs are below 0.7 p.u. For the linear circuit the
current is a source. In each half of a piece it is held at its value in the middle of that half,
extrapolated from the beginning of the piece: the error falls with the square of the length of a
piece. v_f itself follows the parabola through v at the beginning, the middle and the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_plant.solution import draw, sink_source, state
from gfm_runtime.compiled import compiled


@compiled
def drawn(
    P: float, Q: float, least_v2: float, f_r: float, f_i: float, d_r: float, d_i: float
) -> tuple[float, float, float, float]:
    """Return the current at a measured voltage f, and its d/dt when that has the d/dt d."""
    size, grow = f_r * f_r + f_i * f_i, 2.0 * (f_r * d_r + f_i * d_i)
    if size < least_v2:
        size, grow = least_v2, 0.0
    i_r, i_i = (P * f_r + Q * f_i) / size, (P * f_i - Q * f_r) / size
    slope_r, slope_i = (P * d_r + Q * d_i) / size, (P * d_i - Q * d_r) / size
    return i_r, i_i, slope_r - i_r * grow / size, slope_i - i_i * grow / size


@compiled
def draw_power(n: Any, now: Any, c: int, part: int) -> None:
    """Add the currents of all loads of constant power to the forcing of every mode."""
    h = n.half_h[part]
    for j in range(n.n_sinks):
        v_r, v_i = now.w[n.voltage_at[j], 0], now.w[n.voltage_at[j], 1]
        now.v_seen[j, 0, 0], now.v_seen[j, 0, 1] = v_r, v_i
        f_r, f_i = now.v_sink[j, 0], now.v_sink[j, 1]
        d_r, d_i = (v_r - f_r) / n.tau_sink[j], (v_i - f_i) / n.tau_sink[j]
        i_r, i_i, s_r, s_i = drawn(
            n.S_sink[j, 0], n.S_sink[j, 1], n.least_v2[j], f_r, f_i, d_r, d_i
        )
        draw(
            n, now, c, part, sink_source(n, j),
            i_r + 0.5 * h * s_r, i_i + 0.5 * h * s_i, i_r + 1.5 * h * s_r, i_i + 1.5 * h * s_i,
        )  # fmt: skip


@compiled
def see_middle(n: Any, now: Any, c: int) -> None:
    """Keep what all loads of constant power see in the middle of a piece."""
    for j in range(n.n_sinks):
        now.v_seen[j, 1, 0], now.v_seen[j, 1, 1] = state(n, now, c, n.voltage_at[j])


@compiled
def measure(n: Any, now: Any, part: int) -> None:
    """Take the measured voltages on by a piece, at whose end w is."""
    for j in range(n.n_sinks):
        for k in range(2):
            now.v_sink[j, k] = (
                n.sink_weights[part, j, 0] * now.v_sink[j, k]
                + n.sink_weights[part, j, 1] * now.v_seen[j, 0, k]
                + n.sink_weights[part, j, 2] * now.v_seen[j, 1, k]
                + n.sink_weights[part, j, 3] * now.w[n.voltage_at[j], k]
            )


@dataclass(frozen=True)
class PowerLoad:
    """A load of constant power, p.u. of the network.

    Attributes:
        name, node: its own, and where it is.
        S: P + jQ that it draws.
        tau: lag of its measurement, s.
        V_least: voltage below which it is an impedance.
    """

    name: str
    node: str
    S: complex
    tau: float
    V_least: float

    def at_rest(self, v: complex, slip: float) -> tuple[complex, complex]:
        """The measured voltage and the current at rest, at a voltage v that turns with ``slip``,
        rad/s, in the common frame."""
        f = v / complex(1.0, slip * self.tau)
        return f, self.S.conjugate() * f / max(abs(f) ** 2, self.V_least**2)

    def admittance(self, V: float, s: Any) -> NDArray[np.complex128]:
        """The small-signal admittance at a resting voltage that turns at nominal speed: the exact
        derivative of the equations above.

        Its d axis lies on the voltage. Above V_least the load has the negative conductance -P/V^2
        there at low frequencies, which ends at 1/tau.

        Args:
            V: magnitude of the voltage, p.u., > 0.
            s: Laplace variable, 1/s; any shape.

        Returns:
            (i_d, i_q) per (v_d, v_q), shape (*s.shape, 2, 2).
        """
        P, Q = self.S.real, self.S.imag
        if self.V_least < V:
            J = np.array([[-P, Q], [Q, P]]) / V**2
        else:
            J = np.array([[P, Q], [-Q, P]]) / self.V_least**2
        return np.multiply.outer(1.0 / (1.0 + np.asarray(s) * self.tau), J)
