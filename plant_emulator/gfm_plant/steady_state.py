"""The plant's equilibrium: x and u for a given power and voltage."""

import cmath
import math

import numpy as np
from numpy.typing import NDArray

from gfm_plant.records import Record


class NoEquilibrium(ArithmeticError):
    """The plant cannot rest at the wanted operating point."""


def plant_equilibrium(
    par: Record, P: float, V: float, V_g: float = 1.0, omega_g: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the equilibrium x (8,), u (3,) with p = P, terminal voltage V and v_dc = 1.

    Eq. (1)-(8) at rest are a circuit of phasors: power and voltages give the angle across the line,
    that the currents, and these the voltage of the bridge, which turns with the frame. Of the two
    angles at which a line carries P it is the stable one. All arguments in p.u. Raises
    NoEquilibrium: there is none, as for a power beyond what the line carries.
    """
    if not (V > 0 and V_g > 0 and omega_g > 0):
        raise NoEquilibrium(f"V = {V}, V_g = {V_g}, omega_g = {omega_g}: all must be > 0 p.u.")
    r = par[0]
    Z = complex(r["R_g"], omega_g * r["L_g"])
    # P = V^2 R_g/|Z|^2 + V V_g/|Z| sin(angle - loss), where tan(loss) = R_g/X_g
    loss = math.atan2(Z.real, Z.imag)
    middle, swing = V**2 * Z.real / abs(Z) ** 2, V * V_g / abs(Z)
    if not abs(P - middle) <= swing:
        raise NoEquilibrium(
            f"P = {P} p.u.: at V = {V} and V_g = {V_g} p.u. the line of {abs(Z):.4g} p.u. carries"
            f" {middle - swing:.4g} to {middle + swing:.4g} p.u."
        )
    angle = loss + math.asin((P - middle) / swing)
    i_o = (V - V_g * cmath.exp(-1j * angle)) / Z
    i = i_o + 1j * omega_g * float(r["C_f"]) * V
    E = V + complex(r["R_f"], omega_g * r["L_f"]) * i
    E_u, turn = abs(E), E.conjugate() / abs(E)
    if E_u > r["m_max"]:
        raise NoEquilibrium(
            f"P = {P} p.u., V = {V} p.u., V_g = {V_g} p.u.: the bridge would need E_u = "
            f"{E_u:.4g} p.u., its modulation gives {r['m_max']:.4g} p.u."
        )
    w = [part for z in (i * turn, V * turn, i_o * turn) for part in (z.real, z.imag)]
    return np.array([*w, angle + cmath.phase(E), 1.0]), np.array([E_u * w[0], omega_g, E_u])
