"""The plant's equilibrium: x and u for a given power and voltage."""

import math

import numpy as np
from numpy.typing import NDArray

from gfm_plant.model import N_U, N_X, V_DC, f, g
from gfm_plant.records import Record

_ROUNDS = 30
_STEP = 1e-30  # complex step: exact to rounding, as no difference is taken


class NoEquilibrium(ArithmeticError):
    """The plant cannot rest at the wanted operating point."""


def plant_equilibrium(
    par: Record, P: float, V: float, V_g: float = 1.0, omega_g: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the equilibrium x (8,), u (3,) with p = P, terminal voltage V and v_dc = 1.

    Newton's method on the plant's own Eq. (1)-(8), with the Jacobian by complex step. It starts
    from the angle that the line alone would take, and so heads for the stable one of the two angles
    at which a line carries P. All arguments in p.u. Raises NoEquilibrium: If none exists, as for a
    power beyond what the line carries.
    """
    z = _start(par, P, V, V_g, omega_g)
    d = np.array([omega_g, V_g], complex)
    for _ in range(_ROUNDS):
        residual, jacobian = _linearise(z, d, par, P, V)
        try:
            step = np.linalg.solve(jacobian, residual)
        except np.linalg.LinAlgError:  # right at the limit
            break
        z = z - step
        if np.abs(step).max() <= 1e-11 * np.abs(z).max():
            x, u = z[:N_X], z[N_X:]
            if u[2] > par[0]["m_max"] * x[V_DC]:
                raise NoEquilibrium(
                    f"P = {P} p.u., V = {V} p.u., V_g = {V_g} p.u.: the bridge would need E_u = "
                    f"{u[2]:.4g} p.u., its modulation gives {par[0]['m_max'] * x[V_DC]:.4g} p.u."
                )
            return x, u
    raise NoEquilibrium(f"no equilibrium found at P = {P} p.u., V = {V} p.u., V_g = {V_g} p.u.")


def _start(par: Record, P: float, V: float, V_g: float, omega_g: float) -> NDArray[np.float64]:
    """Return a first z = (x, u): the line exactly, the filter as if it were not there."""
    if not (V > 0 and V_g > 0 and omega_g > 0):
        raise NoEquilibrium(f"V = {V}, V_g = {V_g}, omega_g = {omega_g}: all must be > 0 p.u.")
    Z = complex(par[0]["R_g"], omega_g * par[0]["L_g"])
    # P = V^2 R_g/|Z|^2 + V V_g/|Z| sin(angle - loss), where tan(loss) = R_g/X_g
    loss = math.atan2(Z.real, Z.imag)
    middle, swing = V**2 * Z.real / abs(Z) ** 2, V * V_g / abs(Z)
    if abs(P - middle) > swing:
        raise NoEquilibrium(
            f"P = {P} p.u.: at V = {V} and V_g = {V_g} p.u. the line of {abs(Z):.4g} p.u. carries"
            f" {middle - swing:.4g} to {middle + swing:.4g} p.u."
        )
    angle = loss + math.asin((P - middle) / swing)
    i_o = (V - V_g * np.exp(-1j * angle)) / Z
    x = [i_o.real, i_o.imag, V, 0.0, i_o.real, i_o.imag, angle, 1.0]
    return np.array([*x, P, omega_g, V])


def _linearise(
    z: NDArray[np.float64], d: NDArray[np.complex128], par: Record, P: float, V: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what must vanish at z = (x, u), (11,): f and the misses of p, V, v_dc; and d/dz."""
    nudged = z[:, None] + 1j * _STEP * np.eye(N_X + N_U)
    x, u = nudged[:N_X], nudged[N_X:]
    y = g(x, u)
    value = np.concatenate([f(x, u, d, par), [y[1] - P, y[4] - V, y[0] - 1.0]])
    # the values are the same in every column, as a nudge of 1e-30 is nothing
    return value[:, 0].real, value.imag / _STEP
