"""A load of constant power, in whole or in part (ZIP): the current that it draws, along a piece of
time.

The load measures the voltage v of its node as v_f, a space vector in the common frame, with a lag:

    tau dv_f/dt = v - v_f,    i = conj(S) v_f g(max(|v_f|, V_least)),
    g(V) = (1 - a_I - a_Z) / V^2 + a_I / V + a_Z,

where a_I and a_Z are the shares of constant current and impedance at 1 p.u. Without them
i = conj(S / v_f) while |v_f| is above V_least, and below it the load is an impedance, as
the constant-power loads of transmission programs are below 0.7 p.u. For the linear circuit the
current is a source. In each half of a piece it is held at its value in the middle of that half,
extrapolated from the beginning of the piece: the error falls with the square of the length of a
piece. v_f itself follows the parabola through v at the beginning, the middle and the end.
"""

import math
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from gfm_plant.components.part import DRAWN, Drawing, LinearPart, Matrix, see_middle
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import draw
from gfm_runtime.compiled import compiled

_LAG = 5.0  # shortest lag of the measurement, in sampling periods


@compiled
def drawn(one: Any, f: complex, slope: complex) -> tuple[complex, complex]:
    """Return the current at a measured voltage f, and its d/dt when that has this slope."""
    size = f.real * f.real + f.imag * f.imag
    grow = 2.0 * (f.real * slope.real + f.imag * slope.imag)
    if size < one.least_v2:
        size, grow = one.least_v2, 0.0
    per_V = one.a_I / math.sqrt(size)
    power = (1.0 - one.a_I - one.a_Z) / size
    g, g_slope = power + per_V + one.a_Z, -(power + 0.5 * per_V) * grow / size
    own = one.S.conjugate()
    return own * f * g, own * (slope * g + f * g_slope)


@compiled
def _draw(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Add the current to the forcing of every mode."""
    h, v, f = field(n, "half_h")[part], field(now, "w")[one.sees], one.v_f
    one.v_begin = v
    slope = complex((v.real - f.real) / one.tau, (v.imag - f.imag) / one.tau)
    i, di = drawn(one, f, slope)
    draw(
        n, now, c, part, one.source,
        complex(i.real + 0.5 * h * di.real, i.imag + 0.5 * h * di.imag),
        complex(i.real + 1.5 * h * di.real, i.imag + 1.5 * h * di.imag),
    )  # fmt: skip


@compiled
def _end(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Take the measured voltage on by a piece, at whose end w is."""
    a = field(n, "lag_weights")[part, one.lag]
    v, f, v_0, v_1 = field(now, "w")[one.sees], one.v_f, one.v_begin, one.v_middle
    one.v_f = complex(
        a[0] * f.real + a[1] * v_0.real + a[2] * v_1.real + a[3] * v.real,
        a[0] * f.imag + a[1] * v_0.imag + a[2] * v_1.imag + a[3] * v.imag,
    )


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.v_f_before = one.v_f


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.v_f = one.v_f_before


@compiled
def _flow(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    field(now, "flow_i")[one.source] = drawn(one, one.v_f, 0j)[0]


class ConstantPowerLoad(Drawing):
    """A load whose control holds P and Q, such as a drive or a charger: it draws the current
    conj(S / v_f), where v_f follows the voltage of its node with a lag. Shares of it may be a
    constant current or a constant impedance (ZIP). Its node needs a capacitor, as the filter of
    such a load is."""

    title: ClassVar = "Load of constant power, and ZIP load"
    symbol: ClassVar = "load"
    example: ClassVar = {
        "constant_power": {"x": {"node": "bus", "P": 0.1}},
        "capacitors": {"c": {"node": "bus", "Q": 0.1}},
    }
    more_states: ClassVar = (("v_f", "p.u., a space vector", "the voltage that it has measured"),)
    lacks: ClassVar = "{} draws constant power, so the node needs a bank of network.capacitors"
    record: ClassVar = np.dtype(
        [
            *DRAWN, ("lag", "i8"),
            ("S", "c16"),  # P + jQ, p.u. of the network
            ("tau", "f8"),  # s
            ("least_v2", "f8"),  # the square of V_least
            ("a_I", "f8"), ("a_Z", "f8"),
            ("v_f", "c16"), ("v_f_before", "c16"),  # now, and at the last tick
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "keep": _keep, "drive": _draw, "middle": see_middle, "end": _end, "go_back": _go_back,
        "flow": _flow,
    }  # fmt: skip

    node: str = Field(min_length=1, description="where it is; one with a capacitor bank")
    P: float = Field(
        description="active power at 1 p.u., p.u. of the first converter; negative: it feeds in"
    )
    Q: float = Field(0.0, description="reactive power at 1 p.u., p.u.")
    share_I: NonNegative = Field(
        0.0, le=1.0, description="share of P and Q that goes with the voltage: a constant current"
    )
    share_Z: NonNegative = Field(
        0.0, le=1.0, description="share that goes with its square: a constant impedance"
    )
    tau_s: Positive = Field(0.005, description="lag of its measurement of the voltage, s")
    V_least: Positive = Field(
        0.7, description="below this voltage it is an impedance that draws P and Q there, p.u."
    )
    closed: bool = Field(True, description="its breaker at the start")

    @model_validator(mode="after")
    def _shares(self) -> Self:
        if self.share_I + self.share_Z > 1.0:
            raise ValueError(
                f"share_I = {self.share_I:g}, share_Z = {self.share_Z:g}: at most 1 together"
            )
        return self

    @property
    def S(self) -> complex:
        """P + jQ, p.u."""
        return complex(self.P, self.Q)

    def label(self) -> str:
        shares = f", I {self.share_I:g}, Z {self.share_Z:g}" * (self.share_I + self.share_Z > 0.0)
        return f"constant P {self.P:.4g}, Q {self.Q:.4g} p.u.{shares}"

    def lag(self) -> float:
        return self.tau_s

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        if self.tau_s < _LAG * T_s:
            raise ValueError(
                f"{where}: tau_s = {self.tau_s:g}: must be >= {_LAG * T_s:g} s at this T_s"
            )
        record["S"], record["tau"], record["least_v2"] = self.S, self.tau_s, self.V_least**2
        record["a_I"], record["a_Z"] = self.share_I, self.share_Z

    def _by_voltage(self, V: float) -> tuple[float, float]:
        """g at the size V of a voltage, and the d/dV of V g(V)."""
        u = max(V, self.V_least)
        power = (1.0 - self.share_I - self.share_Z) / u**2
        g = power + self.share_I / u + self.share_Z
        return g, self.share_Z - power if self.V_least < V else g

    def current(self, v: complex, slip: float) -> tuple[complex, complex]:
        """The measured voltage and the current that it draws at rest, at a voltage v that turns
        with ``slip``, rad/s, in the common frame."""
        f = v / complex(1.0, slip * self.tau_s)
        return f, self.S.conjugate() * f * self._by_voltage(abs(f))[0]

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        return -self.current(v, omega_b * (omega - 1.0))[1], []

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        record["v_f"], i = self.current(v, omega_b * (omega - 1.0))
        return i

    def admittance(self, V: float, s: Any) -> NDArray[np.complex128]:
        """The small-signal admittance at a resting voltage that turns at nominal speed: the exact
        derivative of the equations above.

        Its d axis lies on the voltage. Above V_least a load of constant power has the negative
        conductance -P/V^2 there at low frequencies, which ends at 1/tau.

        Args:
            V: magnitude of the voltage, p.u., > 0.
            s: Laplace variable, 1/s; any shape.

        Returns:
            (i_d, i_q) per (v_d, v_q), shape (*s.shape, 2, 2).
        """
        across, along = self._by_voltage(V)
        J = np.array([[self.P * along, self.Q * across], [-self.Q * along, self.P * across]])
        return np.multiply.outer(1.0 / (1.0 + np.asarray(s) * self.tau_s), J)

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        f, own = complex(record["v_f"]), complex(-1.0 / self.tau_s, -slip)
        d = f / abs(f) if f else 1.0 + 0j  # its d axis
        turn = np.array([[d.real, -d.imag], [d.imag, d.real]])
        return LinearPart(
            np.array([[own.real, -own.imag], [own.imag, own.real]]),
            np.eye(2) / self.tau_s,
            turn @ self.admittance(abs(f), 0.0).real @ turn.T,
            np.array([-f.imag, f.real]),
        )
