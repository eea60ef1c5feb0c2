"""A synchronous machine in its classical model."""

import cmath
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from gfm_plant.circuit import Branch
from gfm_plant.components.part import Fed, LinearPart, Matrix, emf
from gfm_plant.components.swing import (
    KEPT,
    SWING,
    lead,
    pack_swing,
    record_speed,
    slopes,
    swing,
    swing_at_rest,
    swing_matrix,
)
from gfm_plant.layout import field
from gfm_plant.parameters import NonNegative, Positive
from gfm_plant.solution import drive, state
from gfm_runtime.compiled import compiled


@compiled
def _power(one: Any, unit: complex, i: complex) -> float:
    """Return the power that it gives, p.u. of the network."""
    return one.E * (unit.real * i.real + unit.imag * i.imag)


@compiled
def _drive(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    omega = one.omega + 0.5 * n.T_s * one.slope
    drive(n, now, c, part, one.source, complex(one.E, 0.0), omega)


@compiled
def _middle(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    power = _power(one, field(now, "halfway")[one.source], state(n, now, c, one.sees))
    one.energy -= 4.0 * field(n, "half_h")[part] / 3.0 * power


@compiled
def _bound(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    """Take from its energy, by Simpson's rule, at the beginning and at the end of a piece."""
    power = _power(one, field(now, "unit")[one.source], field(now, "w")[one.sees])
    one.energy -= field(n, "half_h")[part] / 3.0 * power


@compiled
def _tick(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    w = swing(one, n.T_s, one.omega - 1.0)
    one.omega = 1.0 + w
    power = -_power(one, field(now, "unit")[one.source], field(now, "w")[one.sees]) / one.S
    one.slope, _ = slopes(one, w, one.P_turbine, power)
    lead(now, one)


@compiled
def _at_rest(n: Any, now: Any, one: Any, c: int, part: int) -> None:
    power = _power(one, field(now, "unit")[one.source], field(now, "w")[one.sees])
    swing_at_rest(one, one.omega - 1.0, -power)
    one.slope = 0.0


SPEED = [
    ("source", "i8"), ("sees", "i8"),
    ("leads", "i8"),  # without a grid, its speed is omega_g
    *SWING, ("omega", "f8"), ("slope", "f8"),  # its d/dt, 1/s
]  # fmt: skip
"""Fields of the record of a machine."""


class Rotating(Fed):
    """What machines have in common: the swing equation and a governor."""

    symbol: ClassVar = "SM"
    more_states: ClassVar[Sequence[tuple[str, str, str]]] = (
        ("omega", "p.u.", "its speed, by the swing equation"),
        ("angle", "rad", "of its rotor"),
        ("P_turbine", "p.u. of its rating", "power of its turbine, behind the governor"),
    )
    columns: ClassVar = ("true_omega_g",)
    is_voltage: ClassVar = True
    turns: ClassVar = True
    feeds: ClassVar = True

    node: str = Field(min_length=1, description="where it is")
    S: Positive = Field(description="rating over that of the first converter")
    H: Positive = Field(description="inertia constant, s")
    P: float = Field(description="power at nominal frequency, p.u. of its rating")
    D: NonNegative = Field(0.0, description="damping by frequency, p.u./p.u.")
    droop: Positive = Field(0.05, description="frequency by power of the governor, p.u./p.u.")
    T_gov: Positive = Field(0.5, description="lag of governor and turbine, s")

    def sees(self, name: str, banks: Mapping[str, str]) -> str:
        return name

    def asked(self, omega: float) -> float:
        """The power that governor and damping ask for at rest, p.u. of its rating."""
        return self.P - (omega - 1.0) * (1.0 / self.droop + self.D)


class Machine(Rotating):
    """A synchronous machine in its classical model: a constant voltage behind the transient
    reactance, the swing equation, and a governor. It has no voltage regulator, no dampers, no
    saliency and no limits."""

    title: ClassVar = "Synchronous machine"
    example: ClassVar = {"machines": {"x": {"node": "bus", "S": 1.0, "H": 3.0, "P": 0.2}}}
    unknowns: ClassVar = 1  # the angle of its voltage, rad
    record: ClassVar = np.dtype([*SPEED, ("E", "f8")], align=True)
    hooks: ClassVar = {
        "at_rest": _at_rest, "begin": _bound, "drive": _drive, "middle": _middle, "end": _bound,
        "tick": _tick, "flow": record_speed, **KEPT,
    }  # fmt: skip

    E: Positive = Field(1.05, description="voltage behind the reactance, p.u.")
    X: Positive = Field(0.3, description="transient reactance, p.u. of its rating")
    R: NonNegative = Field(0.0, description="resistance, p.u. of its rating")

    def elements(self, name: str) -> tuple[Branch]:
        return (Branch(name, emf(name), self.node, self.X / self.S, self.R / self.S),)

    def label(self) -> str:
        return f"S {self.S:.4g}, H {self.H:g} s, X {self.X:.4g}"

    def pack(self, record: Any, where: str, T_s: float, omega_b: float) -> None:
        pack_swing(self, record, self.X / self.S, where, T_s, omega_b)
        record["E"], record["P_set"] = self.E, self.P

    def steady(
        self, v: complex, omega: float, omega_b: float, z: Matrix
    ) -> tuple[complex, list[float]]:
        voltage = self.E * cmath.exp(1j * z[0])
        i = (voltage - v) / complex(self.R / self.S, omega * (self.X / self.S))
        return i, [(voltage * i.conjugate()).real / self.S - self.asked(omega)]

    def settle(self, record: Any, v: complex, omega: float, omega_b: float, z: Matrix) -> complex:
        record["omega"] = omega
        return complex(self.E * np.exp(1j * z[0]))

    def linear(
        self, record: Any, seen: complex, source: complex, slip: float, omega_b: float
    ) -> LinearPart:
        own, per_power = swing_matrix(self.H, self.D, self.droop, self.T_gov, self.S)
        A, by_seen = np.zeros((3, 3)), np.zeros((3, 2))
        A[0, 1], A[1:, 1:] = omega_b, own
        A[1, 0] = -per_power * (source.conjugate() * seen).imag
        by_seen[1] = -per_power * source.real, -per_power * source.imag
        by_states = np.array([[-source.imag, 0.0, 0.0], [source.real, 0.0, 0.0]])
        return LinearPart(A, by_seen, by_states, np.array([1.0, 0.0, 0.0]))
