"""An induction motor of order 5 and the torque of its load.

All of it is in p.u. of the motor's rating and in the frame that turns at nominal speed; i flows
into the motor. With X_rr = X_r + X_m, k = X_m / X_rr and r = R_r / X_rr the flux of the rotor is a
voltage behind one branch of the circuit that is solved exactly, R_s + k^2 R_r and
X' = X_s + k X_r:

    e = k (j omega - r) psi,    d psi/dt = omega_b (r X_m i - (r + j (1 - omega)) psi),
    2 H d omega/dt = T - T_load (omega / omega_0)^m,    T = k Im(conj(psi) i),

where omega is the speed of the rotor and omega_0 that at the start (Krause, Analysis of Electric
Machinery, symmetrical induction machines). So the stator's own transients are in it too. Within a
tick e is held at its value in the middle of the tick, extrapolated, and the rotor goes on under the
mean current of the tick: the error falls with the square of T_s.
"""

import cmath
import math
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from gfm_plant.circuit import Branch
from gfm_plant.components.part import Fed, LinearPart, Matrix, emf
from gfm_plant.components.swing import STEP, record_speed
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import drive, state
from gfm_runtime.compiled import compiled


@compiled
def _torque(one: Any, psi: complex, i: complex) -> float:
    return one.k * (psi.real * i.imag - psi.imag * i.real)


@compiled
def _load(one: Any, omega: float) -> float:
    """Return the torque of the load at a speed; one that stands still has none."""
    return one.T_load * (max(omega, 0.0) / one.omega_0) ** one.m


@compiled
def _drive(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    drive(n, now, c, part, one.source, one.E_middle, 1.0)


@compiled
def _middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.charge += 4.0 * field(n, "half_h")[part] / 3.0 * state(n, now, c, one.sees)


@compiled
def _bound(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Add to the integral of its current, by Simpson's rule, at both ends of a piece."""
    one.charge += field(n, "half_h")[part] / 3.0 * field(now, "w")[one.sees]


@compiled
def _tick(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    T_s, b = n.T_s, n.omega_b
    i = one.charge * (-1.0 / (T_s * one.S))
    omega = one.omega + 0.5 * T_s * one.slope  # in the middle
    one.omega += T_s * (_torque(one, one.psi_middle, i) - _load(one, omega)) / (2.0 * one.H)
    half = cmath.exp(complex(-one.r, omega - 1.0) * (0.5 * T_s * b))
    psi = half * (half * one.psi + T_s * b * one.r * one.X_m * i)
    one.psi, one.charge = psi, 0j
    _look_ahead(n, now, one, c, part)


@compiled
def _look_ahead(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Set e, and extrapolate e and psi to the middle of the tick that begins."""
    psi, i = one.psi, field(now, "w")[one.sees] * (-1.0 / one.S)
    one.slope = (_torque(one, psi, i) - _load(one, one.omega)) / (2.0 * one.H)
    psi_slope = n.omega_b * (one.r * one.X_m * i + complex(-one.r, one.omega - 1.0) * psi)
    turn = complex(-one.r, one.omega)
    one.E = one.k * turn * psi
    slope = one.k * (turn * psi_slope + 1j * one.slope * psi)
    one.E_middle = one.E + 0.5 * n.T_s * slope
    one.psi_middle = psi + 0.5 * n.T_s * psi_slope
    field(now, "emf")[one.source] = one.E


@compiled
def _keep(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.charge_kept = one.charge


@compiled
def _go_back(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    one.charge = one.charge_kept


class InductionMotor(Fed):
    """An induction motor with one cage, in all its electric transients, and a load whose torque
    goes with a power of the speed. It slows down in a sag, may stall, and draws many times its
    current until it has run up again. The defaults are typical of a large industrial motor."""

    title: ClassVar = "Induction motor"
    symbol: ClassVar = "M"
    example: ClassVar = {"induction_motors": {"x": {"node": "bus", "S": 0.3, "P": 0.8}}}
    more_states: ClassVar = (
        ("psi", "p.u. of its rating, a space vector", "the flux of its rotor"),
        ("omega", "p.u.", "the speed of its rotor"),
    )
    is_voltage: ClassVar = True
    turns: ClassVar = True
    unknowns: ClassVar = 3  # its slip against its island, p.u., and the voltage at its terminals
    record: ClassVar = np.dtype(
        [
            ("source", "i8"), ("sees", "i8"),
            *((name, "f8") for name in ("S", "H", "k", "r", "X_m", "m", "T_load", "omega_0")),
            ("omega", "f8"), ("slope", "f8"),  # its d/dt, 1/s
            ("psi", "c16"), ("E", "c16"), ("psi_middle", "c16"), ("E_middle", "c16"),
            # integral of its branch's current since the last tick, p.u. of the network and s
            ("charge", "c16"), ("charge_kept", "c16"),
        ],
        align=True,
    )  # fmt: skip
    hooks: ClassVar = {
        "at_rest": _look_ahead, "begin": _bound, "drive": _drive, "middle": _middle, "end": _bound,
        "tick": _tick, "flow": record_speed, "keep": _keep, "go_back": _go_back,
    }  # fmt: skip

    node: str = Field(min_length=1, description="where it is")
    S: Positive = Field(description="rating over that of the first converter")
    P: float = Field(0.8, description="power that it draws at the start, p.u. of its rating")
    H: Positive = Field(1.5, description="inertia constant of motor and load, s")
    R_s: NonNegative = Field(0.013, description="resistance of the stator, p.u. of its rating")
    X_s: Positive = Field(0.067, description="leakage reactance of the stator, p.u.")
    X_m: Positive = Field(3.8, description="magnetising reactance, p.u.")
    R_r: Positive = Field(0.009, description="resistance of the rotor, p.u.")
    X_r: Positive = Field(0.17, description="leakage reactance of the rotor, p.u.")
    load_exponent: NonNegative = Field(
        2.0, description="the load's torque goes with this power of the speed: 2 of a fan or pump"
    )

    @property
    def k(self) -> float:
        """Share of the rotor's flux that the stator sees."""
        return self.X_m / (self.X_r + self.X_m)

    @property
    def r(self) -> float:
        """Of the rotor, 1/(omega_b times its time constant), p.u."""
        return self.R_r / (self.X_r + self.X_m)

    def elements(self, name: str) -> tuple[Branch]:
        X, R = self.X_s + self.k * self.X_r, self.R_s + self.k**2 * self.R_r
        return (Branch(name, emf(name), self.node, X / self.S, R / self.S),)

    def label(self) -> str:
        return f"S {self.S:.4g}, P {self.P:.4g}, H {self.H:g} s"

    def sees(self, name: str, banks: Any) -> str:
        return name

    def impedance(self, slip: Any, omega: float = 1.0) -> Any:
        """That of its equivalent circuit, p.u. of its rating, at a slip, p.u. of nominal speed, any
        shape, and a speed of the voltage."""
        by_rotor = slip / (self.R_r + 1j * slip * self.X_r)
        return self.R_s + 1j * omega * self.X_s + omega / (1 / (1j * self.X_m) + by_rotor)

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        draws = (1.0 / self.impedance(np.linspace(-1.0, 1.0, 20_001))).real
        least, most = draws.min(), draws.max()
        if not least < self.P < most:
            raise ValueError(
                f"{where}: P = {self.P:g}: at nominal voltage it draws between {least:.3g} and"
                f" {most:.3g} p.u. of its rating"
            )
        X = self.X_s + self.k * self.X_r
        if (rate := max(math.sqrt(omega_b / (2 * self.H * X)), self.r * omega_b)) * T_s > STEP:
            raise ValueError(
                f"{where}: it moves at {rate:.6g} rad/s; allowed are {STEP / T_s:.6g} rad/s at this"
                " T_s; raise H, or lower R_r"
            )
        for name in ("S", "H", "k", "r", "X_m"):
            record[name] = getattr(self, name)
        record["m"] = self.load_exponent

    def _flux(self, v: complex, slip: float, omega: float) -> tuple[complex, complex]:
        """Its current and the flux of its rotor at rest, p.u. of its rating."""
        i = complex(v / self.impedance(slip, omega))
        return i, self.X_m * i / complex(1.0, slip / self.r)

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        i, _ = self._flux(v, float(z[0]), omega)
        terminal = v - complex(*z[1:])
        return -self.S * i, [(v * i.conjugate()).real - self.P, terminal.real, terminal.imag]

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        slip = float(z[0])
        i, psi = self._flux(complex(*z[1:]), slip, omega)
        record["omega"] = record["omega_0"] = omega - slip
        record["psi"], record["T_load"] = psi, self.k * (psi.conjugate() * i).imag
        record["E"] = E = self.k * complex(-self.r, omega - slip) * psi
        return E

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        psi, omega, i = complex(record["psi"]), float(record["omega"]), -seen / self.S
        A, by_seen, by_states = np.zeros((3, 3)), np.zeros((3, 2)), np.zeros((2, 3))
        A[:2, :2] = _as_matrix(omega_b * complex(-self.r, omega - 1.0) - 1j * slip)
        A[:2, 2] = -omega_b * psi.imag, omega_b * psi.real
        per = self.k / (2 * self.H)
        A[2, :2] = per * i.imag, -per * i.real
        T_load = float(record["T_load"]) * (omega / float(record["omega_0"])) ** self.load_exponent
        A[2, 2] = -self.load_exponent * T_load / omega / (2 * self.H)
        by_seen[:2] = -omega_b * self.r * self.X_m / self.S * np.eye(2)
        by_seen[2] = per * psi.imag / self.S, -per * psi.real / self.S
        by_states[:, :2] = _as_matrix(self.k * complex(-self.r, omega))
        by_states[:, 2] = -self.k * psi.imag, self.k * psi.real
        return LinearPart(A, by_seen, by_states, np.array([-psi.imag, psi.real, 0.0]))


def _as_matrix(c: complex) -> Matrix:
    """What a product with c does to the two parts of a number."""
    return np.array([[c.real, -c.imag], [c.imag, c.real]])
