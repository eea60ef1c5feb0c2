"""Where the plant rests: x and u at which a wanted power and voltage are an equilibrium."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gfm_plant.model import DELTA, N_U, N_X, V_DC, f, g
from gfm_plant.records import PlantRecord

_ROUNDS = 30
_STEP = 1e-30  # complex step: exact to rounding, as no difference is taken


class NoEquilibrium(ArithmeticError):
    """The plant cannot rest at the wanted operating point."""


def plant_equilibrium(
    par: PlantRecord, P: float, V: float, V_g: float = 1.0, omega_g: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the equilibrium x (8,), u (3,) with p = P, terminal voltage V and v_dc = 1.

    Newton's method on the plant's own Eq. (1)-(8), with the Jacobian by complex step, starting
    from the angle that a lossless line would take. All arguments in p.u.

    Raises:
        NoEquilibrium: If none exists, as for a power beyond what the line carries.
    """
    d = np.array([omega_g, V_g], complex)
    z = _start(par, P, V, V_g, omega_g)
    for _ in range(_ROUNDS):
        jacobian = np.empty((N_X + N_U, N_X + N_U))
        for j in range(N_X + N_U):
            nudged = z.astype(complex)
            nudged[j] += _STEP * 1j
            jacobian[:, j] = _residual(nudged, d, par, P, V).imag / _STEP
        residual = _residual(z.astype(complex), d, par, P, V).real
        try:
            step = np.linalg.solve(jacobian, residual)
        except np.linalg.LinAlgError:
            break
        z = z - step
        if not np.isfinite(z).all():
            break
        if np.abs(step).max() <= 1e-11 * max(1.0, np.abs(z).max()):
            return z[:N_X], z[N_X:]
    X_g = omega_g * float(par[0]["L_g"])
    raise NoEquilibrium(
        f"no equilibrium at P = {P} p.u., V = {V} p.u., V_g = {V_g} p.u.:"
        f" the line of {X_g:.4g} p.u. carries about {V * V_g / X_g:.4g} p.u. at most"
    )


def _residual(
    z: NDArray[np.complex128], d: NDArray[np.complex128], par: PlantRecord, P: float, V: float
) -> NDArray[np.complex128]:
    """Return what must vanish at z = (x, u): f, and the misses of p, V and v_dc."""
    x, u = z[:N_X], z[N_X:]
    y = g(x, u)
    return np.concatenate([f(x, u, d, par), [y[1] - P, y[4] - V, y[0] - 1.0]])


def _start(par: PlantRecord, P: float, V: float, V_g: float, omega_g: float) -> NDArray[np.float64]:
    X_g = omega_g * float(par[0]["L_g"])
    angle = math.asin(min(max(P * X_g / max(V * V_g, 1e-9), -0.95), 0.95))
    i_o = (V - V_g * np.exp(-1j * angle)) / complex(par[0]["R_g"], X_g)
    z = np.zeros(N_X + N_U)
    z[[0, 1, 4, 5]] = i_o.real, i_o.imag, i_o.real, i_o.imag
    z[2], z[DELTA], z[V_DC] = V, angle, 1.0
    z[N_X:] = P, omega_g, V
    return z
