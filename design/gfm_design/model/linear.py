"""Plant and law linearised at an operating point, and the plant from tick to tick.

The plant's matrices come from ``gfm_plant.model.f`` and ``g`` by complex step, which takes no
difference and is exact to rounding. The sampled plant is exact too: each input is held over its
delay (whole samples and a fraction: the modified z-transform), the sensors' low-pass belongs to
the plant that is held, and delayed outputs are read between samples. Quantisation, noise and
limits are left out. All in p.u. and s. ``model.closed_loop`` closes the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.operating_point import OperatingPoint
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.swing import swing_matrix
from gfm_plant.model import DELTA, N_X, V_DC, f, g
from gfm_plant.names import SENSED
from gfm_plant.pv_array import array_slope
from gfm_plant.records import ACROSS, Record
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.law import BuiltLaw
from gfm_runtime.realisation import LawStateSpace
from gfm_runtime.signals import NU, NY, NY_INNER
from gfm_runtime.tustin import DiscreteLaw, close_omega_u, tustin

Matrix = NDArray[np.float64]
Vector = NDArray[np.complex128]

_STEP = 1e-30  # complex step
_NUDGE = 1e-6  # central differences, for the error map alone: it is compiled for real numbers
_WHOLE = 1e-9  # samples; a fraction below this is rounding
_MEASURED = list(SENSED)
_D, _Q = slice(0, 6, 2), slice(1, 6, 2)  # the axes of (i, v, i_o) in the plant's state


@dataclass(frozen=True)
class LinearPlant:
    """x' = A x + B u + B_d d,  y = C x: deviations from the operating point.

    x' is dx/dt, or the x of the next tick. Shapes: A (n,n), B (n,3), B_d (n,2), C and C_true (5,n);
    for an inner stage B is (n,4) and C (11,n), in the order of the signal table. Several plants
    have one leading axis more. The first eight states are those of ``gfm_plant.model``; a regulated
    DC source adds its integral, one with a lag its current, a finite grid its frequency and its
    turbines' power, band-limited sensors add four, and a sampled plant ends with its delay lines.
    C gives what the controller reads and C_true what the sensors measure. The omega_u row of both
    is 0, since a law is fed its own omega_u; only a PLL reads the omega_u that acts.
    """

    A: Matrix
    B: Matrix
    B_d: Matrix
    C: Matrix
    C_true: Matrix

    @classmethod
    def stacked(cls, plants: Sequence[LinearPlant]) -> LinearPlant:
        """Several plants of the same size on a leading axis."""
        return cls(*(np.stack([getattr(p, f.name) for p in plants]) for f in fields(cls)))


@dataclass(frozen=True)
class LinearLaw:
    """The law around its operating point: x' = A x + B y + B_r r,  u = C x + D y + D_r r.

    x' is dx/dt, or the x of the next tick. The omega_u loop is closed and the error map is in the
    matrices, so y and r are plain measurements and references. Shapes: A (m,m), B and B_r (m,5),
    C (3,m), D and D_r (3,5); with an inner stage B is (m,11), C (4,m), D (4,11) and D_r (4,5).
    Several laws have leading axes. ``rows`` names the row of u that each state of the law belongs
    to; rows that do not act have no states.
    """

    A: Matrix
    B: Matrix
    C: Matrix
    D: Matrix
    B_r: Matrix
    D_r: Matrix
    rows: tuple[int, ...] = field(default=(), kw_only=True)

    @property
    def matrices(self) -> tuple[Matrix, ...]:
        """(A, B, C, D, B_r, D_r)."""
        return self.A, self.B, self.C, self.D, self.B_r, self.D_r

    def sampled(self, T_s: float) -> LinearLaw:
        """A continuous law at the sampling time T_s [s], by Tustin."""
        inputs = np.concatenate([self.B, self.B_r], axis=-1)
        through = np.concatenate([self.D, self.D_r], axis=-1)
        A, B, C, D = tustin(self.A, inputs, self.C, through, T_s / 2)
        parts = (A, B[..., :NY], C, D[..., :NY], B[..., NY:], D[..., NY:])
        return LinearLaw(*parts, rows=self.rows)


@dataclass(frozen=True)
class Mode:
    """One real mode, or one complex pair: exp(sigma t) cos(2 pi frequency_hz t)."""

    sigma: float  # 1/s, positive grows
    frequency_hz: float  # 0 for a real mode

    @property
    def ratio(self) -> float:
        """Damping ratio, -sigma over the distance from s = 0."""
        size = float(np.hypot(self.sigma, 2 * np.pi * self.frequency_hz))
        return -self.sigma / size if size else 0.0

    def words(self) -> str:
        """Where it is and how fast it grows, for a message."""
        where = f"at {self.frequency_hz:.4g} Hz" if self.frequency_hz else "(real)"
        return f"mode {where} grows by {self.sigma:.3g} 1/s"

    def plain(self) -> dict[str, Any]:
        """sigma [1/s], frequency_hz and ratio, for JSON."""
        return {"sigma": self.sigma, "frequency_hz": self.frequency_hz, "ratio": self.ratio}

    @classmethod
    def of(cls, s: complex) -> Mode:
        """The mode of a pole s [1/s]."""
        return cls(float(s.real), float(abs(s.imag) / (2 * np.pi)))


def linearise_plant(
    par: Record,
    op: OperatingPoint,
    omega_g: float = 1.0,
    V_g: float = 1.0,
    grid: FiniteGrid | None = None,
    inner: bool = False,
) -> LinearPlant:
    """The plant with its DC source and sensors in its steady state ``op``, on a grid of omega_g and
    V_g, ideal or finite; ``inner``: with the commands and the measurements of an inner stage."""
    r = par[0]
    commands = op.commands if inner else op.u
    n_u = len(commands)
    at = np.concatenate([op.x, commands, [omega_g, V_g]])
    slopes = np.empty((N_X + NY + 1, len(at)))
    for j in range(len(at)):
        z = at.astype(complex)
        z[j] += 1j * _STEP
        x, u, d = np.split(z, [N_X, N_X + n_u])
        p_g = d[1] * (np.cos(x[DELTA]) * x[4] - np.sin(x[DELTA]) * x[5])
        slopes[:, j] = np.concatenate([_rates(x, u, d, par), g(x, u), [p_g]]).imag / _STEP
    controlled, lags = int(r["i_u_gain"] != 0.0), int(r["tau_dc"] > 0.0)
    regulated = int(not controlled and r["array"] != ACROSS)
    finite, sensors = 2 * int(grid is not None), 4 * int(r["filtered"])
    source, swing = N_X + regulated, N_X + regulated + lags  # where the states begin
    n = swing + finite
    s = slice(n, n + sensors)
    A, C = np.zeros((n + sensors, n + sensors)), np.zeros((NY, n + sensors))
    B, B_d = np.zeros((n + sensors, n_u)), np.zeros((n + sensors, 2))
    A[:N_X, :N_X], B[:N_X], B_d[:N_X] = np.split(slopes[:N_X], [N_X, N_X + n_u], axis=1)
    C[_MEASURED, :N_X] = slopes[N_X:-1][_MEASURED, :N_X]
    C_true = C.copy()
    per_i_dc, asked = B[V_DC, 0], np.zeros(n + sensors)  # the current asked of the DC source, by x
    B[V_DC, 0] = 0.0
    if regulated:
        asked[V_DC], asked[N_X], A[N_X, V_DC] = -r["k_p"], 1.0, -r["k_i"]
    if r["array"] == ACROSS:
        asked[V_DC] = array_slope(r, op.x[V_DC])
    if lags:
        A[source], B[source, 0] = asked / r["tau_dc"], controlled / r["tau_dc"]
        A[source, source] -= 1 / r["tau_dc"]
        A[V_DC, source] = per_i_dc
    else:
        A[V_DC] += per_i_dc * asked
        B[V_DC, 0] = per_i_dc * controlled
    if grid is not None:  # omega_g is a state, and so is the power of the turbines
        A[:, swing], B_d[:, 0] = B_d[:, 0], 0.0
        own, per_power = swing_matrix(grid.H, grid.D, grid.droop, grid.T_gov, grid.S)
        A[swing, :N_X], B_d[swing, 1] = slopes[-1, :N_X] * per_power, slopes[-1, -1] * per_power
        A[swing : swing + 2, swing : swing + 2] = own
    if sensors:
        A[s, :n], A[s, s] = r["omega_s"] * C[_MEASURED, :n], -r["omega_s"] * np.eye(4)
        C = np.zeros_like(C)
        C[_MEASURED, s] = np.eye(4)
    C[_MEASURED] *= r["gain"][: len(_MEASURED), None]
    if inner:  # the currents and voltages pass no filter
        prompt = np.eye(NY_INNER - NY, n + sensors)
        C = np.vstack([C, r["gain"][len(_MEASURED) :, None] * prompt])
    return LinearPlant(A, B, B_d, C, C_true)


def _rates(x: Vector, u: Vector, d: Vector, par: Record) -> Vector:
    """``gfm_plant.model.f``, under (i_u, omega_u, e_d, e_q) too: f has its voltage on the d axis,
    and its equations are the same in any frame that is turned by a constant angle."""
    if len(u) == NU:
        return np.asarray(f(x, u, d, par))
    size = np.sqrt(u[2] * u[2] + u[3] * u[3])
    cos, sin = u[2] / size, u[3] / size
    turned = x.copy()
    turned[_D], turned[_Q] = cos * x[_D] + sin * x[_Q], cos * x[_Q] - sin * x[_D]
    turned[DELTA] += 2.0 * np.arctan(sin / (1.0 + cos))
    there = f(turned, np.array([u[0], u[1], size]), d, par)
    dx = there.copy()
    dx[_D], dx[_Q] = cos * there[_D] - sin * there[_Q], cos * there[_Q] + sin * there[_D]
    return np.asarray(dx)


def linearise_law(
    law: BuiltLaw,
    ss: DiscreteLaw | LawStateSpace,
    op: OperatingPoint,
    ref: Matrix,
    dc_control: bool,
) -> LinearLaw:
    """A law, discrete or continuous, around ``op``; ``dc_control`` says that row 1 acts."""
    slopes = error_map_slopes(law.error_map, law.error_parameters, op.y, ref)
    return closed_law(ss, slopes, dc_control)


def closed_law(
    ss: DiscreteLaw | LawStateSpace, slopes: tuple[Matrix, Matrix], dc_control: bool
) -> LinearLaw:
    """State space with the error map's slopes and the omega_u loop in it.

    The matrices may have leading axes, one entry a law.
    """
    mapped_r, mapped_y = slopes
    # one matrix for (y, r), so that the omega_u loop is closed through both at once
    B = ss.B_r @ mapped_r + ss.B_y @ mapped_y
    D = ss.D_r @ mapped_r + ss.D_y @ mapped_y
    D[..., NY:] += ss.D_u0
    A, B, C, D = close_omega_u(ss.A, B, ss.C, D)
    k = [i for i, row in enumerate(ss.rows) if dc_control or row != 0]
    A, B, C = A[..., k, :][..., k], B[..., k, :], C[..., k]
    parts = (A, B[..., :NY], C, D[..., :NY], B[..., NY:], D[..., NY:])
    return LinearLaw(*parts, rows=tuple(ss.rows[i] for i in k))


def error_map_slopes(
    error_map: str, parameters: Sequence[float], y: Matrix, ref: Matrix
) -> tuple[Matrix, Matrix]:
    """Slopes of the mapped r and of the mapped y over (y, r), both (5,10)."""
    if error_map == "linear":
        zero, eye = np.zeros((NY, NY)), np.eye(NY)
        return np.hstack([zero, eye]), np.hstack([eye, zero])
    impedance = np.zeros(2)
    impedance[: len(parameters)] = parameters
    mapped = np.empty((2, 2, NY, 2 * NY))  # up or down, r or y, component, by which input
    for k, sign in enumerate((1.0, -1.0)):
        for j in range(2 * NY):
            inputs = np.concatenate([y, ref])
            inputs[j] += sign * _NUDGE
            z, r = inputs[:NY], inputs[NY:]
            map_errors(ERROR_MAPS[error_map], impedance, r, z)
            mapped[k, 0, :, j], mapped[k, 1, :, j] = r, z
    slopes = (mapped[0] - mapped[1]) / (2 * _NUDGE)
    return slopes[0], slopes[1]


def inverse_tustin(
    A: Matrix, B: Matrix, C: Matrix, D: Matrix, half: float
) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """The continuous system whose discretisation by Tustin is x' = A x + B w, z = C x + D w.

    It has the same norms, at tan(omega half)/half in place of omega. The matrices may have leading
    axes. ``half`` is half the sampling time in s; no eigenvalue may be at -1.
    """
    eye = np.eye(A.shape[-1])
    forward = 2.0 * np.linalg.inv(A + eye)
    return (
        (eye - forward) / half,
        forward @ B / (2.0 * half),
        C @ forward,
        D - 0.5 * C @ forward @ B,
    )


def hold(A: Matrix, B: Matrix, T: float) -> tuple[Matrix, Matrix]:
    """exp(A T) and the integral of exp(A t) B over (0, T): the plant over a held input."""
    n, m = B.shape
    M = np.zeros((n + m, n + m))
    M[:n, :n], M[:n, n:] = A * T, B * T
    halvings = max(0, int(np.ceil(np.log2(max(np.abs(M).sum(axis=1).max(), 1e-300)))) + 2)
    M /= 2.0**halvings
    term = out = np.eye(n + m)
    for k in range(1, 16):  # the norm is at most 1/4: the 16th term is below 1e-22
        term = term @ M / k
        out = out + term
    for _ in range(halvings):
        out = out @ out
    return out[:n, :n], out[:n, n:]


def delay_lines(plant: LinearPlant, T_s: float, u_delay: Matrix, y_delay: Matrix) -> list[slice]:
    """Where the delay line of each u, then of each y, is among the states of ``sampled_plant``."""
    splits = _splits(plant, T_s, u_delay, y_delay)
    counts = [whole + (part > 0.0) for of in splits for whole, part in of]
    ends = len(plant.A) + np.cumsum([0, *counts])
    return [slice(int(a), int(b)) for a, b in pairwise(ends)]


def sampled_plant(
    plant: LinearPlant,
    T_s: float,
    u_delay: Matrix,
    y_delay: Matrix,
    reads: Sequence[tuple[int, int]] = (),
) -> LinearPlant:
    """The plant from tick to tick, with delay lines as states.

    u_j[k] acts ``u_delay[j]`` seconds after its tick, through its own hold; y_i[k] is y_i
    ``y_delay[i]`` seconds before its tick, between samples too. Both are shifts of continuous
    signals, so nothing is approximated. d is held from tick to tick and not delayed.

    Args:
        plant: a single continuous plant.
        T_s: sampling time, s.
        u_delay, y_delay: of each u and each y, s, all >= 0.
        reads: pairs of a command and a measurement that is the one that acts at its tick, as a PLL
            needs omega_u.
    """
    n, n_u = len(plant.A), plant.B.shape[1]
    u_split, y_split = _splits(plant, T_s, u_delay, y_delay)
    lines = delay_lines(plant, T_s, u_delay, y_delay)
    size = lines[-1].stop + len(reads)
    now = np.eye(size + n_u + plant.B_d.shape[1])  # (state, u[k], d[k]) by rows
    aged = [np.vstack([now[size + j], now[lines[j]]]) for j in range(n_u)]  # u_j[k], ...
    step = np.zeros((size, len(now)))
    for line, values in zip(lines, aged, strict=False):
        step[line] = values[:-1]
    # through the tick, from one switching of a command or reading of an output to the next
    switches = [part * T_s for _, part in u_split]
    readings = [(1.0 - part) * T_s if part else 0.0 for _, part in y_split]
    x, inputs = now[:n], np.hstack([plant.B, plant.B_d])
    for t, then in pairwise(sorted({0.0, T_s, *switches, *readings})):
        for i, line in enumerate(lines[n_u:]):
            if line.stop > line.start and t == readings[i]:
                step[line] = np.vstack([plant.C[i] @ x, now[line][:-1]])
        u = [aged[j][whole + (t < switches[j])] for j, (whole, _) in enumerate(u_split)]
        A, B = hold(plant.A, inputs, then - t)
        x = A @ x + B @ np.vstack([*u, now[size + n_u :]])
    step[:n] = x
    read = [now[line.stop - 1, :size] for line in lines[n_u:]]  # the oldest of each line
    C_true = np.pad(plant.C_true, ((0, 0), (0, size - n)))
    prompt = np.pad(plant.C, ((0, 0), (0, size - n)))
    C = np.where([[line.stop > line.start] for line in lines[n_u:]], read, prompt)
    for place, (command, measurement) in enumerate(reads, size - len(reads)):
        step[place], C[measurement] = u[command], now[place, :size]
    A, B, B_d = np.split(step, [size, size + n_u], axis=1)
    return LinearPlant(A, B, B_d, C, C_true)


Splits = list[tuple[int, float]]


def _splits(
    plant: LinearPlant, T_s: float, u_delay: Matrix, y_delay: Matrix
) -> tuple[Splits, Splits]:
    """Whole samples and fraction of each u and y; a command that does not act needs no line."""

    def split(delay: float) -> tuple[int, float]:
        samples = float(delay) / T_s
        whole = int(np.floor(samples + _WHOLE))
        part = samples - whole
        return whole, part if part > _WHOLE else 0.0

    u = [split(d) if plant.B[:, j].any() else (0, 0.0) for j, d in enumerate(u_delay)]
    return u, [split(d) for d in y_delay]
