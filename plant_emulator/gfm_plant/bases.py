"""Per-unit bases: how SI values and p.u. values of one converter relate.

The AC side is based on the nominal apparent power S_n and the line-to-line RMS voltage V_n,
the DC side on S_n and the DC voltage reference V_dcref, so that v_dc = 1 p.u. at its reference
and one p.u. of power is the same on both sides.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Bases:
    """Bases of one converter; the defaults are Table "Parameters Used in Simulations".

    Attributes:
        S_n: Nominal apparent power in VA.
        V_n: Nominal line-to-line RMS voltage in V.
        omega_n: Nominal angular frequency in rad/s.
        V_dcref: DC voltage reference in V.

    Raises:
        ValueError: If a base is not a positive finite number.
    """

    S_n: float = 4000.0
    V_n: float = 380.0
    omega_n: float = 100 * math.pi
    V_dcref: float = 700.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{field.name} = {value!r}: a base must be finite and > 0")

    @property
    def S_b(self) -> float:
        """Power base in VA (also of active and reactive power, and of the DC side)."""
        return self.S_n

    @property
    def V_b(self) -> float:
        """AC voltage base, line-to-line RMS, in V."""
        return self.V_n

    @property
    def omega_b(self) -> float:
        """Angular frequency base in rad/s: the omega_b of Eq. (1)-(8)."""
        return self.omega_n

    @property
    def I_b(self) -> float:
        """AC current base, line RMS, in A."""
        return self.S_b / (math.sqrt(3) * self.V_b)

    @property
    def Z_b(self) -> float:
        """AC impedance base in ohm."""
        return self.V_b**2 / self.S_b

    @property
    def L_b(self) -> float:
        """AC inductance base in H."""
        return self.Z_b / self.omega_b

    @property
    def C_b(self) -> float:
        """AC capacitance base in F."""
        return 1 / (self.Z_b * self.omega_b)

    @property
    def I_dcb(self) -> float:
        """DC current base in A."""
        return self.S_b / self.V_dcref

    @property
    def Z_dc(self) -> float:
        """DC impedance base in ohm."""
        return self.V_dcref**2 / self.S_b

    @property
    def C_dcb(self) -> float:
        """DC capacitance base in F."""
        return 1 / (self.Z_dc * self.omega_b)

    def base_of(self, quantity: str) -> float:
        """Return the SI value that is 1 p.u. of `quantity`.

        Raises:
            ValueError: If `quantity` is none of `QUANTITIES`.
        """
        if quantity == "f":
            return self.omega_b / (2 * math.pi)
        if quantity not in _BASE_PROPERTY:
            raise ValueError(f"quantity = {quantity!r}: must be one of {', '.join(QUANTITIES)}")
        base: float = getattr(self, _BASE_PROPERTY[quantity])
        return base

    def to_pu(self, value: float, quantity: str) -> float:
        """Convert `value` from SI units to p.u.; `quantity` is one of `QUANTITIES`."""
        return value / self.base_of(quantity)

    def to_si(self, value: float, quantity: str) -> float:
        """Convert `value` from p.u. to SI units; `quantity` is one of `QUANTITIES`."""
        return value * self.base_of(quantity)


_BASE_PROPERTY = {
    "P": "S_b",
    "Q": "S_b",
    "V": "V_b",
    "I": "I_b",
    "omega": "omega_b",
    "R": "Z_b",
    "L": "L_b",
    "C": "C_b",
    "v_dc": "V_dcref",
    "i_dc": "I_dcb",
    "C_dc": "C_dcb",
}

QUANTITIES = (*_BASE_PROPERTY, "f")
"""The quantities that have a base; in SI: W, var, V, A, rad/s, ohm, H, F, V, A, F and Hz."""
