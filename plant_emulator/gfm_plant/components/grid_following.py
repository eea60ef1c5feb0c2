"""A grid-following converter: a current that follows its set-points in the frame of its PLL.

With v the voltage of its node in the frame of the PLL, whose d axis is at theta in the common
frame, and i the current that it brings, p.u. of its rating:

    d theta/dt = x + k_p v_q,    dx/dt = k_i v_q,
    T_i di/dt = i* - i,    i* = conj(S / v) - j b v / |v|,    |i*| <= I_max,
    T_V dV/dt = |v| - V,    b = k_V times what V - 1 is beyond the dead band, below it positive,

where v in i* is at least V_least long. Where it supports the voltage (b is not 0), its reactive
current has the first place within I_max; else i* is shortened at the angle that it has. For the
linear circuit the current is a source. In each half of a piece it is held at its value in the
middle of that half, extrapolated from the beginning of the piece: the error falls with the square
of the length of a piece. Its states go on by RK4, with the voltage at the beginning, in the middle
and at the end.
"""

import cmath
import math
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from gfm_plant.components.part import DRAWN, Drawing, LinearPart, Matrix, see_middle
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import draw
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import P_SET, Q_SET

THETA, X, I_D, I_Q, V = range(5)
"""Its states."""
N_STATES = 5
_FASTEST = 0.2  # largest rate times T_s
_NUDGE = 1e-6  # of a derivative by differences


@compiled
def _rates(one: Any, s: Any, v: complex, out: Any) -> None:
    """Write d/dt of the states, 1/s, at a voltage v in the common frame."""
    cos, sin = math.cos(s[THETA]), math.sin(s[THETA])
    v_d, v_q = v.real * cos + v.imag * sin, v.imag * cos - v.real * sin
    out[THETA], out[X] = s[X] + one.k_p * v_q, one.k_i * v_q
    size = max(v_d * v_d + v_q * v_q, one.least_v2)
    i_d, i_q = (one.P * v_d + one.Q * v_q) / size, (one.P * v_q - one.Q * v_d) / size
    b = one.k_V * (max(1.0 - one.band - s[V], 0.0) - max(s[V] - 1.0 - one.band, 0.0))
    if b != 0.0:
        size = math.sqrt(size)
        across = min(max(one.Q / size + b, -one.I_max), one.I_max)
        most = math.sqrt(one.I_max * one.I_max - across * across)
        along = min(max(one.P / size, -most), most)
        i_d, i_q = (along * v_d + across * v_q) / size, (along * v_q - across * v_d) / size
    scale = min(1.0, one.I_max / math.sqrt(max(i_d * i_d + i_q * i_q, 1e-18)))
    out[I_D], out[I_Q] = (scale * i_d - s[I_D]) / one.T_i, (scale * i_q - s[I_Q]) / one.T_i
    out[V] = (math.sqrt(v_d * v_d + v_q * v_q) - s[V]) / one.T_V


@compiled
def _drawn(one: Any, s: Any) -> complex:
    """Return the current that it draws, p.u. of the network, in the common frame."""
    cos, sin = math.cos(s[THETA]), math.sin(s[THETA])
    return complex(-one.S * (s[I_D] * cos - s[I_Q] * sin), -one.S * (s[I_D] * sin + s[I_Q] * cos))


@compiled
def _take_set_points(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Take P and Q of its plant controller, if it has one."""
    if one.follower >= 0:
        points = field(now, "set_points")
        P, Q = points[one.follower, P_SET], points[one.follower, Q_SET]
        one.P, one.Q = (P if P == P else one.P), (Q if Q == Q else one.Q)


@compiled
def _draw(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    h, v, s, rate = field(n, "half_h")[part], field(now, "w")[one.sees], one.s, one.rate
    one.v_begin = v
    _rates(one, s, v, rate)
    i, turn = _drawn(one, s), rate[THETA]
    cos, sin = math.cos(s[THETA]), math.sin(s[THETA])
    slope = complex(
        -one.S * (rate[I_D] * cos - rate[I_Q] * sin) - turn * i.imag,
        -one.S * (rate[I_D] * sin + rate[I_Q] * cos) + turn * i.real,
    )
    draw(
        n, now, c, part, one.source,
        complex(i.real + 0.5 * h * slope.real, i.imag + 0.5 * h * slope.imag),
        complex(i.real + 1.5 * h * slope.real, i.imag + 1.5 * h * slope.imag),
    )  # fmt: skip


@compiled
def _end(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Take the states on by a piece, at whose end w is."""
    h, v_end, s = 2.0 * field(n, "half_h")[part], field(now, "w")[one.sees], one.s
    _rates(one, s, one.v_begin, one.k_1)
    for j in range(N_STATES):
        one.guess[j] = s[j] + 0.5 * h * one.k_1[j]
    _rates(one, one.guess, one.v_middle, one.k_2)
    for j in range(N_STATES):
        one.guess[j] = s[j] + 0.5 * h * one.k_2[j]
    _rates(one, one.guess, one.v_middle, one.k_3)
    for j in range(N_STATES):
        one.guess[j] = s[j] + h * one.k_3[j]
    _rates(one, one.guess, v_end, one.k_4)
    for j in range(N_STATES):
        s[j] += h / 6.0 * (one.k_1[j] + 2.0 * (one.k_2[j] + one.k_3[j]) + one.k_4[j])


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    for j in range(N_STATES):
        one.kept[j] = one.s[j]


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    for j in range(N_STATES):
        one.s[j] = one.kept[j]


@compiled
def _flow(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    field(now, "flow_i")[one.source] = _drawn(one, one.s)
    field(now, "flow_omega")[one.source] = 1.0 + one.s[X] / n.omega_b


class GridFollowing(Drawing):
    """A grid-following converter: a PLL, a current control as one lag, set-points of P and Q, a
    limit of the current, and reactive current by the voltage beyond a dead band: fast and with a
    wide one it is the support in a fault, slow and without one a Volt-VAR control. It has no DC
    link and no filter of its own: its node needs a capacitor bank, as the filter of such a
    converter is."""

    title: ClassVar = "Grid-following converter"
    symbol: ClassVar = "GFL"
    example: ClassVar = {
        "grid_following": {"x": {"node": "bus", "S": 0.5, "P": 0.5}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}},
    }
    more_states: ClassVar = (
        ("theta, x", "rad, rad/s", "of its PLL"),
        ("i_d, i_q", "p.u. of its rating", "its current in the frame of the PLL"),
        ("V", "p.u.", "the voltage that it has measured, to support it"),
    )
    feeds: ClassVar = True
    turns: ClassVar = True
    lacks: ClassVar = "{} brings a current, so the node needs a bank of network.capacitors"
    record: ClassVar = np.dtype(
        [
            *DRAWN, ("follower", "i8"),  # its place among the set-points; -1: it has none
            *((x, "f8") for x in ("S", "P", "Q", "k_p", "k_i", "T_i", "I_max", "least_v2")),
            *((x, "f8") for x in ("k_V", "band", "T_V")),
            *((x, "f8", (N_STATES,)) for x in ("s", "kept", "rate", "guess")),
            *((x, "f8", (N_STATES,)) for x in ("k_1", "k_2", "k_3", "k_4")),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "keep": _keep, "begin": _take_set_points, "drive": _draw, "middle": see_middle,
        "end": _end, "go_back": _go_back, "flow": _flow,
    }  # fmt: skip

    node: str = Field(min_length=1, description="where it is; one with a capacitor bank")
    S: Positive = Field(description="rating over that of the first converter")
    P: float = Field(description="set-point of the power that it brings, p.u. of its rating")
    Q: float = Field(0.0, description="set-point of its reactive power, p.u.")
    k_p: Positive = Field(60.0, description="gain of its PLL, rad/s by p.u. of voltage")
    k_i: NonNegative = Field(900.0, description="integral gain of its PLL, rad/s^2 by p.u.")
    T_i: Positive = Field(0.002, description="lag of its current control, s")
    I_max: Positive = Field(1.2, description="largest current, p.u. of its rating")
    k_V: NonNegative = Field(
        0.0, description="reactive current by the voltage beyond the dead band, p.u./p.u."
    )
    band: NonNegative = Field(0.1, description="dead band around 1 p.u. of that voltage, p.u.")
    T_V: Positive = Field(0.005, description="lag of the measurement of that voltage, s")
    V_least: Positive = Field(0.2, description="least voltage by which it divides its power, p.u.")
    closed: bool = Field(True, description="its breaker at the start")

    def label(self) -> str:
        return f"S {self.S:.4g}, P {self.P:.4g}, Q {self.Q:.4g}"

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        rates = {"k_p": self.k_p, "k_i": math.sqrt(self.k_i)}
        rates |= {"T_i": 1.0 / self.T_i, "T_V": 1.0 / self.T_V}
        for name, rate in rates.items():
            if rate * T_s > _FASTEST:
                raise ValueError(
                    f"{where}: {name} = {getattr(self, name):g}: as fast as {rate:.6g} rad/s;"
                    f" allowed are {_FASTEST / T_s:.6g} rad/s at this T_s"
                )
        for name in ("S", "P", "Q", "k_p", "k_i", "T_i", "I_max", "k_V", "band", "T_V"):
            record[name] = getattr(self, name)
        record["least_v2"], record["follower"] = self.V_least**2, -1

    def brings(self, v: complex) -> complex:
        """Its current at rest, p.u. of its rating, at a voltage v."""
        one = SimpleNamespace(**self.model_dump(), least_v2=self.V_least**2)
        theta, rate = cmath.phase(v), np.zeros(N_STATES)
        _rates.py_func(one, (theta, 0.0, 0.0, 0.0, abs(v)), v, rate)
        return self.T_i * complex(rate[I_D], rate[I_Q]) * cmath.exp(1j * theta)

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        return self.S * self.brings(v), []

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        theta = cmath.phase(v)
        i = self.brings(v) * cmath.exp(-1j * theta)
        record["s"] = theta, omega_b * (omega - 1.0), i.real, i.imag, abs(v)
        return complex(-self.S * self.brings(v))

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        """By differences of the equations above, in the frame that turns with the island."""
        one = SimpleNamespace(**{name: record[name] for name in record.dtype.names})

        def moved(nudge: Matrix) -> Matrix:
            """d/dt of the states (N_STATES,), and the source (2,), after a nudge of states and
            voltage."""
            s, out = one.s + nudge[:N_STATES], np.zeros(N_STATES)
            _rates.py_func(one, s, seen + complex(*nudge[N_STATES:]), out)
            i = _drawn.py_func(one, s)
            return np.array([out[THETA] - slip, *out[1:], i.real, i.imag])

        found = np.stack(
            [(moved(x) - moved(-x)) / (2 * _NUDGE) for x in _NUDGE * np.eye(N_STATES + 2)], axis=1
        )
        turn = np.zeros(N_STATES)
        turn[THETA], own = 1.0, slice(N_STATES)
        return LinearPart(found[own, own], found[own, N_STATES:], found[N_STATES:, own], turn)
