"""The operating point of a converter under a law: the equilibrium of their own equations.

Unknowns are the plant's states, the DC current, E_u and the law's states; omega_u is the grid's.
The equations are the plant's Eq. (1)-(8) (``gfm_plant.model.f``, not a copy of it), the law's
x = A x + B (r, y) and u = u_0 + C x + D (r, y) at its sampling time, with y as the sensors report
it. A regulated DC source holds v_dc = 1, and row 1 of the law does not act.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gfm_plant import NoEquilibrium, plant_equilibrium
from gfm_plant.model import DELTA, N_X, V_DC, f, g
from gfm_plant.names import SENSED
from gfm_plant.records import PlantRecord
from gfm_runtime import LawError
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.tustin import DiscreteLaw

Vector = NDArray[np.float64]

_ROUNDS = 40
_NUDGE = 1e-7  # central differences; the error map is compiled for real numbers only


@dataclass(frozen=True)
class OperatingPoint:
    """The common equilibrium of plant and law, all in p.u.

    Attributes:
        x: the plant's state, shape (8,), order as in ``gfm_plant.model``, in the frame of the law:
            its E_u lies on the d axis.
        u: the law's output, shape (3,); i_u is the current of the DC source, also of a regulated
            one.
        y: the outputs as the sensors report them, shape (5,).
        x_law: the law's state, shape (n,).
        e: the bridge's voltage e_d + j e_q in that frame; E_u without an inner stage.
    """

    x: Vector
    u: Vector
    y: Vector
    x_law: Vector
    e: complex

    @property
    def commands(self) -> Vector:
        """(i_u, omega_u, e_d, e_q), shape (4,), p.u.: what the bridge gets."""
        return np.array([self.u[0], self.u[1], self.e.real, self.e.imag])


def operating_point(
    par: PlantRecord,
    law: DiscreteLaw,
    ref: Vector,
    omega_g: float = 1.0,
    V_g: float = 1.0,
) -> OperatingPoint:
    """Solve for the operating point by Newton's method.

    Args:
        par: the plant's parameters, from ``gfm_plant.make_plant``.
        law: the law at its sampling time.
        ref: references (V_dcref, P_ref, omega_g, Q_ref, V_ref), shape (5,), p.u.
        omega_g, V_g: the grid, p.u.

    Raises:
        NoEquilibrium: the law has no rest state there (a frequency that its droop cannot reach
            within the line's capacity, or no steady state at all).
    """
    if law.law.inner is not None and law.law.inner.f_pll > 0.0:
        ref = np.array([*ref[:2], omega_g, *ref[3:]])  # the law sees what its PLL measures
    controlled = par[0]["i_u_gain"] != 0.0
    # row 1's states are left out of a plant whose DC source ignores it
    kept = np.array([i for i, row in enumerate(law.rows) if controlled or row != 0], dtype=int)
    start_x, start_u = plant_equilibrium(par, ref[1], ref[4], V_g, omega_g)
    z = np.concatenate([start_x, [start_u[0], start_u[2]], np.zeros(len(kept))])
    d = np.array([omega_g, V_g])

    def residual(z: Vector) -> Vector:
        x, u, y, x_law = _unpack(z, par, law, omega_g, kept)
        u_law, x_next = _law(law, x_law, ref, y)
        dx = f(x, u, d, par)
        dc = u_law[0] - u[0] if controlled else x[V_DC] - 1.0
        ac = np.delete(dx, DELTA)  # delta rests by omega_u = omega_g
        u[2] = abs(_internal(law, x, u, limited=False))
        rest = (x_next - x_law)[kept] / law.T_s
        return np.concatenate([ac, [dc, u_law[1] - omega_g, u_law[2] - u[2]], rest])

    for _ in range(_ROUNDS):
        now = residual(z)
        jacobian = np.empty((len(z), len(z)))
        for j in range(len(z)):
            nudge = np.zeros(len(z))
            nudge[j] = _NUDGE
            jacobian[:, j] = (residual(z + nudge) - residual(z - nudge)) / (2 * _NUDGE)
        step = np.linalg.lstsq(jacobian, now, rcond=1e-12)[0]
        largest = np.abs(step).max()
        z = z - step * min(1.0, 0.5 / largest if largest > 0 else 1.0)
        if not np.isfinite(z).all():
            break
        if largest < 1e-10:
            if np.abs(residual(z)).max() > 1e-5:
                break
            x, u, y, x_law = _unpack(z, par, law, omega_g, kept)
            x, u, e = _in_frame_of_law(law, x, u)
            return OperatingPoint(x, u, y, x_law, e)
    idle = controlled and not (law.C[0].any() or law.D_y[0].any())
    cause = "; nothing holds v_dc: row 1 answers to no measurement" if idle else ""
    raise NoEquilibrium(
        f"{law.law.name} has no steady state at P_ref = {ref[1]:g} p.u., V_ref = {ref[4]:g} p.u., "
        f"omega_g = {omega_g:g} p.u., V_g = {V_g:g} p.u.{cause}"
    )


def _internal(law: DiscreteLaw, x: Vector, u: Vector, limited: bool = True) -> complex:
    """The law's E for a bridge that rests at u: with an inner stage another voltage, behind it."""
    inner, e = law.law.inner, complex(u[2])
    if inner is None:
        return e
    if not limited:
        inner = replace(inner, I_max=math.inf)
    i, v, i_o = (complex(x[k], x[k + 1]) for k in (0, 2, 4))
    try:
        return inner.internal_voltage(i, v, i_o, e, float(u[1]))
    except LawError as problem:
        raise NoEquilibrium(str(problem)) from None


def _in_frame_of_law(law: DiscreteLaw, x: Vector, u: Vector) -> tuple[Vector, Vector, complex]:
    """The state, the law's output and the bridge's voltage, turned so that E lies on the d axis."""
    E = _internal(law, x, u)
    turn = E.conjugate() / abs(E)
    turned = x.copy()
    for k in (0, 2, 4):
        w = complex(x[k], x[k + 1]) * turn
        turned[k : k + 2] = w.real, w.imag
    turned[DELTA] += cmath.phase(E)
    return turned, np.array([u[0], u[1], abs(E)]), u[2] * turn


def _unpack(
    z: Vector, par: PlantRecord, law: DiscreteLaw, omega_g: float, kept: NDArray[np.intp]
) -> tuple[Vector, Vector, Vector, Vector]:
    x, u = z[:N_X].copy(), np.array([z[N_X], omega_g, z[N_X + 1]])
    y = g(x, u)
    measured = np.array(SENSED)
    gain, offset = (par[0][name][: len(measured)] for name in ("gain", "offset"))
    y[measured] = gain * y[measured] + offset
    x_law = np.zeros(law.order)
    x_law[kept] = z[N_X + 2 :]
    return x, u, y, x_law


def _law(law: DiscreteLaw, x: Vector, ref: Vector, y: Vector) -> tuple[Vector, Vector]:
    """u (3,) of the law and its next state at held inputs; column 3 sees the plant's omega_u."""
    r, measured = ref.copy(), y.copy()
    impedance = np.zeros(2)
    impedance[: len(law.law.error_parameters)] = law.law.error_parameters
    map_errors(ERROR_MAPS[law.law.error_map], impedance, r, measured)
    u = law.u_0 + law.D_u0 @ ref + law.C @ x + law.D_r @ r + law.D_y @ measured
    return u, law.A @ x + law.B_r @ r + law.B_y @ measured
