"""The inner stage linearised at an operating point at which none of its limits acts.

The equations are those of ``gfm_runtime.inner``, tick by tick, with its own packed constants:
virtual stator or voltage loop, current loop, the low-pass on v, and the PLL. A voltage, a current
or an integral of both axes is one complex number here, as in the docstring of that module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearLaw
from gfm_design.model.operating_point import OperatingPoint
from gfm_plant import NoEquilibrium
from gfm_runtime.inner import (
    INNER_NUMBERS,
    DualSequence,
    GridFollowingStage,
    InnerStage,
    StiffSource,
    ThresholdImpedance,
    VirtualStator,
    inner_fields,
    pack_inner,
)
from gfm_runtime.signals import NU, NU_INNER, NY, NY_INNER
from gfm_runtime.tustin import OMEGA_COLUMN, OMEGA_ROW

Matrix = NDArray[np.float64]

_ROUNDING = 1e-6  # p.u., of an operating point; exactly at a limit the stage does not limit


@dataclass(frozen=True)
class LinearStage:
    """An inner stage from tick to tick, as deviations in p.u. from its operating point:

        x' = A x + B_u u + B_y y + B_r r,
        (i_u, omega_u, e_d, e_q) = C x + D_u u + D_y y + D_r r.

    u (3,) is the law's output, y (11,) what the run measures, and r (5,) the references, which
    most stages leave to the law. With a PLL the law sees C_pll x + D_pll y in place of its
    reference omega_g; without one both are 0. Shapes: A (n,n), B_u (n,3), B_y (n,11), B_r (n,5),
    C (4,n), D_u (4,3), D_y (4,11), D_r (4,5), C_pll (1,n), D_pll (1,11); several stages have one
    leading axis more. ``states`` names the states.
    """

    A: Matrix
    B_u: Matrix
    B_y: Matrix
    B_r: Matrix
    C: Matrix
    D_u: Matrix
    D_y: Matrix
    D_r: Matrix
    C_pll: Matrix
    D_pll: Matrix
    states: tuple[str, ...] = field(kw_only=True)

    @classmethod
    def stacked(cls, stages: Sequence[LinearStage]) -> LinearStage:
        """Several stages of the same states on a leading axis."""
        names = [f.name for f in fields(cls) if f.name != "states"]
        each = (np.stack([getattr(s, name) for s in stages]) for name in names)
        return cls(*each, states=stages[0].states)

    @property
    def has_pll(self) -> bool:
        """Whether the stage measures omega_g, for which it reads the omega_u that acts."""
        return bool(self.D_pll.any())

    def around(self, law: LinearLaw) -> LinearLaw:
        """The law from tick to tick and the stage as one: y (11,) in, (i_u, omega_u, e_d, e_q) out.

        The law or the stage may have leading axes, or both the same.
        """
        g = [OMEGA_COLUMN]  # the reference omega_g
        more = [(0, 0)] * (law.B.ndim - 1) + [(0, NY_INNER - NY)]
        B = np.pad(law.B, more) + law.B_r[..., g] @ self.D_pll
        D = np.pad(law.D, more) + law.D_r[..., g] @ self.D_pll
        x_by, u_by = law.B_r[..., g] @ self.C_pll, law.D_r[..., g] @ self.C_pll
        B_r, D_r = law.B_r, law.D_r
        if self.has_pll:
            B_r, D_r = B_r.copy(), D_r.copy()
            B_r[..., g], D_r[..., g] = 0.0, 0.0
        return LinearLaw(
            _block([law.A, x_by], [self.B_u @ law.C, self.A + self.B_u @ u_by]),
            _block([B], [self.B_u @ D + self.B_y]),
            _block([self.D_u @ law.C, self.C + self.D_u @ u_by]),
            self.D_u @ D + self.D_y,
            _block([B_r], [self.B_u @ D_r + self.B_r]),
            self.D_u @ D_r + self.D_r,
            rows=law.rows,
        )


def _block(*rows: list[Matrix]) -> Matrix:
    """Blocks of matrices, each of which may have leading axes."""
    many = np.broadcast_shapes(*(m.shape[:-2] for row in rows for m in row))
    wide = [[np.broadcast_to(m, (*many, *m.shape[-2:])) for m in row] for row in rows]
    return np.concatenate([np.concatenate(row, axis=-1) for row in wide], axis=-2)


def linearise_stage(
    inner: InnerStage, T_s: float, omega_b: float, op: OperatingPoint
) -> LinearStage:
    """A stage around ``op``.

    Args:
        T_s: sampling time, s.
        omega_b: base frequency of the converter, rad/s.

    Raises:
        NoEquilibrium: a limit of the stage acts at ``op``.
    """
    if isinstance(inner, StiffSource):
        _check_limits(inner, op, 0.0)
        return _without_states()
    c = np.zeros(1, np.dtype([*INNER_NUMBERS, *inner_fields(np.dtype(float))]))[0]
    pack_inner(inner, c, T_s, omega_b)
    omega_0, dual = float(op.u[1]), isinstance(inner, DualSequence)
    i_0, v_0, i_o_0 = (complex(op.x[k], op.x[k + 1]) for k in (0, 2, 4))
    _check_limits(inner, op, abs(i_0))
    both, states = _states(inner, c)
    # A quantity is a row over w = (x, u, y, r): its real and imaginary part are those of row @ w.
    n = len(states)
    w = np.eye(n + NU + NY_INNER + NY)
    omega, E, y = w[n + OMEGA_ROW], w[n + 2], w[n + NU :]
    i, v, i_o = (y[k] + 1j * y[k + 1] for k in (NY, NY + 2, NY + 4))
    x = {name: w[2 * k] + 1j * w[2 * k + 1] for k, name in enumerate(both)}
    seen, after, turns = np.zeros(len(w)), list[NDArray[np.float64]](), omega
    then = {"v_f": x["v_f"] + c["follow_v"] * (v - x["v_f"])}
    if dual:  # steady, there is no negative sequence: the turning of its frame is constant
        h = 2.0 * omega_0 * c["half_turn"]
        h += h**3 * c["third"]
        back = (1.0 - 1j * h) / (1.0 + 1j * h)

        def split_sequences(name: str, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
            ahead = back * x[f"{name}_n"]
            lack = c["follow_s"] * (z - x[f"{name}_p"] - ahead)
            then.update({f"{name}_p": x[f"{name}_p"] + lack, f"{name}_n": ahead + lack})
            return ahead + lack

        E = E - split_sequences("E", E) - (c["R_more"] + 1j * c["X_more"]) * x["i_n"]
    if inner.f_pll > 0.0:
        angle, frequency = w[n - 2], w[n - 1]
        error = (v / v_0).imag - angle
        seen = frequency + c["T_k_pll"] * error
        turned = angle + 2.0 * c["half_turn"] * (seen + c["k_pll"] * error - y[OMEGA_COLUMN])
        after = [turned, seen]
    if isinstance(inner, GridFollowingStage):
        E = then["v_f"] + (c["R_v"] + 1j * c["X_v"]) * i
        omega, turns = seen, seen + c["give_back"] * E.imag / op.u[2]
        i_ref, own = _asked_current(inner, c, op, w, n, then["v_f"], seen, turned)
        after = [*own, *after]
    elif isinstance(inner, VirtualStator):
        lacks = op.e - v_0 - 1j * omega_0 * c["L_f"] * i_0
        i_ref_0 = i_0 if inner.k_ci > 0.0 else i_0 + lacks / c["k_c"]
        turn = 1j * omega_0 * c["half_turn"]
        drive = c["stator_b"] * (E - v) - 2j * c["half_turn"] * i_ref_0 * omega
        i_ref = ((1.0 - c["stator_a"] - turn) * x["i*"] + drive) / (1.0 + c["stator_a"] + turn)
        then["i*"] = i_ref
    else:
        Z_v = c["R_v"] + 1j * omega_0 * c["X_v"]
        error = E - Z_v * i_o - 1j * c["X_v"] * i_o_0 * omega - v
        i_ref = c["k_v"] * error + x.get("x_v", 0.0) + c["k_ff"] * i_o
        i_ref = i_ref + 1j * c["C_f"] * (omega_0 * v + v_0 * omega)
        if "x_v" in x:
            then["x_v"] = x["x_v"] + c["T_k_vi"] * error
    e = then["v_f"] + c["k_c"] * (i_ref - i) + x.get("x_c", 0.0)
    e = e + 1j * c["L_f"] * (omega_0 * i + i_0 * omega)
    if dual:
        lead = c["lead_d"] + 1j * c["lead_q"] - 2j * omega_0 * c["L_f"]
        e = e + lead * split_sequences("i", i_ref)
    if "x_c" in x:
        then["x_c"] = x["x_c"] + c["T_k_ci"] * (i_ref - i)
    rows = [part for name in both for part in (then[name].real, then[name].imag)]
    out = np.array([w[n], turns, e.real, e.imag])
    split = [n, n + NU, n + NU + NY_INNER]
    each = (np.split(m, split, axis=1) for m in (np.array([*rows, *after]), out, seen[None, :]))
    (A, B_u, B_y, B_r), (C, D_u, D_y, D_r), (C_pll, _, D_pll, _) = each
    of = A, B_u, B_y, B_r, C, D_u, D_y, D_r, C_pll, D_pll
    return LinearStage(*of, states=tuple(states))


def _asked_current(
    inner: GridFollowingStage,
    c: np.void,
    op: OperatingPoint,
    w: Matrix,
    n: int,
    v_f: NDArray[np.complex128],
    omega: Matrix,
    angle: Matrix,
) -> tuple[NDArray[np.complex128], list[Matrix]]:
    """i* of a grid-following stage, and the next of its own states, which end n - 2 states.

    Args:
        w, n: rows and number of states, as in ``linearise_stage``.
        v_f, omega, angle: the filtered voltage, and the frequency and angle of the PLL, after the
            tick.
    """
    v_0, omega_0 = complex(op.x[2], op.x[3]), float(op.u[1])
    size, ahead = abs(v_0), v_0 / abs(v_0)
    y, ref = w[n + NU :], w[n + NU + NY_INNER :]
    i_0 = inner.reference(complex(op.x[0], op.x[1]), v_0, op.e, omega_0)
    P_of, Q_of = (i_0 / ahead).real, omega_0 * c["C_f"] * size - (i_0 / ahead).imag
    V = w[n - 3] + c["follow_V"] * ((v_f / ahead).real - w[n - 3])
    droops, error, then = abs(1.0 - omega_0) >= inner.band_f, y[0] - ref[0], [V]
    power = ref[1] - (c["k_f"] * droops) * omega + c["k_dc"] * error
    if c["T_k_dci"] > 0.0:
        power, then = power + w[n - 4], [w[n - 4] + c["T_k_dci"] * error, V]
    along = (power - P_of * V) / size
    across = (Q_of * V - ref[3]) / size + c["C_f"] * (omega_0 * V + size * omega)
    return ahead * (along + 1j * across) + 1j * i_0 * angle, then


def _without_states() -> LinearStage:
    """A stage whose bridge produces E_u itself."""
    none, D_u = np.zeros((0, 0)), np.eye(NU_INNER, NU)
    B_u, B_y, C = np.zeros((0, NU)), np.zeros((0, NY_INNER)), np.zeros((NU_INNER, 0))
    D_y, C_pll = np.zeros((NU_INNER, NY_INNER)), np.zeros((1, 0))
    B_r, D_r = np.zeros((0, NY)), np.zeros((NU_INNER, NY))
    return LinearStage(none, B_u, B_y, B_r, C, D_u, D_y, D_r, C_pll, D_y[:1], states=())


def _states(inner: InnerStage, c: np.void) -> tuple[list[str], list[str]]:
    """The states that have both axes, by their symbols; and all states, one axis each, in words."""
    stator = isinstance(inner, VirtualStator)
    follows = isinstance(inner, GridFollowingStage)
    acts = {"v_f": True, "i*": stator, "x_v": not stator and c["T_k_vi"] > 0.0}
    acts["x_c"] = c["T_k_ci"] > 0.0
    acts |= dict.fromkeys(("i_p", "i_n", "E_p", "E_n"), isinstance(inner, DualSequence))
    both = [name for name, there in acts.items() if there]
    states = [f"{name} of the inner stage, {axis}" for name in both for axis in "dq"]
    states += ["x_v of the inner stage"] if follows and c["T_k_dci"] > 0.0 else []
    states += ["V of the inner stage"] if follows else []
    states += ["angle of the PLL", "frequency of the PLL"] if inner.f_pll > 0.0 else []
    return both, states


def _check_limits(inner: InnerStage, op: OperatingPoint, size: float) -> None:
    """Refuse an operating point at which a limit acts; |i*| is within I_max at any."""
    p, e, most = float(op.y[1]), abs(op.e), inner.m * float(op.y[0])
    V = abs(complex(op.x[2], op.x[3]))
    why = ""
    if not inner.P_min - _ROUNDING <= p <= inner.P_max + _ROUNDING:
        why = (
            f"the power limiter acts: p is {p:.4g} p.u., not in [{inner.P_min:g}, {inner.P_max:g}]"
        )
    elif isinstance(inner, ThresholdImpedance) and size > inner.I_thr:
        why = f"the threshold impedance acts: |i| is {size:.4g} p.u., I_thr is {inner.I_thr:g}"
    elif isinstance(inner, GridFollowingStage) and inner.k_V > 0 and abs(1.0 - V) >= inner.band_V:
        why = f"the support of the voltage acts: V is {V:.4g} p.u., beyond its dead band"
    elif isinstance(inner, GridFollowingStage) and inner.V_least >= V:
        why = f"V is {V:.4g} p.u., below V_least = {inner.V_least:g}"
    elif isinstance(inner, StiffSource) and not inner.rests(e, float(op.y[3])):
        why = f"a limit of E or q acts: E is {e:.4g} p.u., q {op.y[3]:.4g} p.u."
    elif e > most + _ROUNDING:
        why = f"the limit of modulation acts: |e| is {e:.4g} p.u., m v_dc is {most:.4g}"
    if why:
        raise NoEquilibrium(f"inner: {why}; a linear model needs a point where no limit acts")
