"""Per-unit bases: how SI values and p.u. values of one converter relate.

The AC side is based on the nominal apparent power S_n and the line-to-line RMS voltage V_n,
the DC side on S_n and the DC voltage reference V_dcref, so that v_dc = 1 p.u. at its reference
and one p.u. of power is the same on both sides.
"""

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
    def omega_b(self) -> float:
        """Angular frequency base in rad/s: the omega_b of Eq. (1)-(8)."""
        return self.omega_n

    @property
    def V_peak(self) -> float:
        """1 p.u. of a phase's instantaneous voltage, V."""
        return self.V_n * math.sqrt(2 / 3)

    @property
    def I_peak(self) -> float:
        """1 p.u. of a phase's instantaneous current, A."""
        return self.S_n / (1.5 * self.V_peak)

    def base_of(self, quantity: str) -> float:
        """Return the SI value that is 1 p.u. of `quantity`. Raises ValueError: If `quantity` is
        none of `QUANTITIES`."""
        S, V, w = self.S_n, self.V_n, self.omega_n
        Z, Z_dc = V**2 / S, self.V_dcref**2 / S
        values = (
            S, S, V, S / (math.sqrt(3) * V), w, Z, Z / w, 1 / (Z * w),
            self.V_dcref, S / self.V_dcref, 1 / (Z_dc * w), w / (2 * math.pi),
        )  # fmt: skip
        if quantity not in QUANTITIES:
            raise ValueError(f"quantity = {quantity!r}: must be one of {', '.join(QUANTITIES)}")
        return values[QUANTITIES.index(quantity)]

    def to_pu(self, value: float, quantity: str) -> float:
        """Convert `value` from SI units to p.u.; `quantity` is one of `QUANTITIES`."""
        return value / self.base_of(quantity)

    def to_si(self, value: float, quantity: str) -> float:
        """Convert `value` from p.u. to SI units; `quantity` is one of `QUANTITIES`."""
        return value * self.base_of(quantity)


QUANTITIES = ("P", "Q", "V", "I", "omega", "R", "L", "C", "v_dc", "i_dc", "C_dc", "f")
"""The quantities that have a base; in SI: W, var, V (line-to-line RMS), A (line RMS), rad/s, ohm,
H, F, V, A, F and Hz."""
