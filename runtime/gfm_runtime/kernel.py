"""The fixed-step kernel: one njit function for every law.

A law reaches the kernel as one record of ``law_dtype`` (constants) and one of ``state_dtype``
(what changes). Both are plain C structs with constant-size arrays, so that firmware can hold the
same bytes. The kernel knows no law by name, allocates nothing, calls no BLAS and no clock.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_runtime.compiled import inlined
from gfm_runtime.counts import COUNTS_NUMBERS, counts_fields, counts_state_fields, pack_counts
from gfm_runtime.error_maps import ERROR_MAPS, map_errors
from gfm_runtime.errors import LawError
from gfm_runtime.inner import (
    INNER_NUMBERS,
    NONE,
    STIFF,
    faded,
    inner_fields,
    inner_state_fields,
    limited,
    measure_frequency,
    pack_inner,
    shape,
    take_measurements,
)
from gfm_runtime.signals import NU, NY
from gfm_runtime.tustin import DiscreteLaw

N_MAX = 12  # states; the largest law of Table II has five
TREND_TIME = 0.01  # s; u[k] - u[k-1] is filtered with this before a bumpless change uses it


def law_dtype(real: DTypeLike = np.float64) -> np.dtype[Any]:
    """Record of a law's constants; ``real`` is float64 or float32."""
    f = np.dtype(real)
    return np.dtype(
        [
            ("n", "i8"),
            ("error_map", "i8"),
            ("row", "i8", (N_MAX,)),  # of u that each state belongs to
            *INNER_NUMBERS,
            *COUNTS_NUMBERS,
            ("error_parameters", f, (2,)),
            ("A", f, (N_MAX, N_MAX)),
            ("B_r", f, (N_MAX, NY)),
            ("B_y", f, (N_MAX, NY)),
            ("C", f, (NU, N_MAX)),
            ("D_r", f, (NU, NY)),
            ("D_y", f, (NU, NY)),
            ("D_u0", f, (NU, NY)),
            ("u_0", f, (NU,)),
            ("loop", f),  # 1/(1 - D_y[1,2]): the omega_u loop in closed form
            ("low", f, (NU,)),
            ("high", f, (NU,)),
            ("W", f, (N_MAX, NU)),
            ("decay", f),  # of the offset, per tick
            ("follow", f),  # of the trend filter, per tick
            ("E_r", f, (N_MAX, NY)),
            ("E_y", f, (N_MAX, NY)),
            ("F", f, (N_MAX, NU)),
            ("G", f, (N_MAX, NU)),
            *inner_fields(f),
            *counts_fields(f),
        ],
        align=True,
    )


def state_dtype(real: DTypeLike = np.float64) -> np.dtype[Any]:
    """Record of a running law's variables, scratch space included, so a step allocates nothing."""
    f = np.dtype(real)
    return np.dtype(
        [
            ("limited", "i8"),  # whether the inner stage limits the current in this tick
            ("x", f, (N_MAX,)),
            ("x_next", f, (N_MAX,)),
            ("r", f, (NY,)),  # mapped references of this tick
            ("y", f, (NY,)),  # mapped measurements of this tick, omega_u the law's own
            ("raw", f, (NU,)),  # u before the limits
            ("now", f, (NU,)),  # u of this tick, within the limits
            ("offset", f, (NU,)),  # left by a bumpless change, decays
            ("u", f, (NU,)),  # u of the last tick
            ("trend", f, (NU,)),  # filtered u[k] - u[k-1]
            ("ref", f, (NY,)),  # references of this tick as given, for a u_0 that follows one
            *inner_state_fields(f),
            *counts_state_fields(f),
        ],
        align=True,
    )


@np.errstate(over="ignore")  # what overflows is refused below
def pack_law(
    discrete: DiscreteLaw, real: DTypeLike = np.float64, omega_b: float = 100 * math.pi
) -> NDArray[Any]:
    """A discrete law as a one-element array of ``law_dtype``.

    Args:
        omega_b: base frequency of the converter, rad/s, for the inner stage and for counts.

    Raises:
        LawError: more states than the kernel holds, a number that overflows ``real``, or a timer
            that does not fit T_s.
    """
    n, law = discrete.order, discrete.law
    if n > N_MAX:
        raise LawError(law.name, f"{n} states; the kernel holds {N_MAX}")
    out = np.zeros(1, law_dtype(real))
    rec = out[0]
    rec["n"], rec["error_map"] = n, ERROR_MAPS[law.error_map]
    rec["error_parameters"][: len(law.error_parameters)] = law.error_parameters
    rec["A"][:n, :n], rec["C"][:, :n] = discrete.A, discrete.C
    for name in ("B_r", "B_y", "W", "E_r", "E_y", "F", "G"):
        rec[name][:n] = getattr(discrete, name)
    for name in ("D_r", "D_y", "D_u0", "u_0"):
        rec[name] = getattr(discrete, name)
    rec["loop"] = 1.0 / (1.0 - discrete.D_y[1, 2])
    rec["low"], rec["high"] = law.limits.low, law.limits.high
    rec["row"][:n] = discrete.rows
    pack_inner(law.inner, rec, discrete.T_s, omega_b)
    pack_counts(law.counts, rec, discrete.T_s, omega_b)
    rec["decay"] = np.exp(-discrete.T_s / law.limits.T_off)
    rec["follow"] = -np.expm1(-discrete.T_s / TREND_TIME)
    for name in ("A", "B_r", "B_y", "C", "D_r", "D_y", "u_0", "W", "E_r", "E_y", "F", "G"):
        if not np.isfinite(rec[name]).all():
            raise LawError(law.dynamic(), f"{name} is not finite in {np.dtype(real)}")
    return out


@inlined
def set_inputs(law, state, ref, y):
    """The references and measurements of this tick, p.u., and what the error map makes of them."""
    for j in range(NY):
        state.ref[j] = state.r[j] = ref[j]
        state.y[j] = y[j]
    map_errors(law.error_map, law.error_parameters, state.r, state.y)


@inlined
def _row(law, state, i):
    """u_i without the omega_u column: u_0 + C x + D_r r + D_y y + offset."""
    a = law.u_0[i] + state.offset[i]
    for j in range(law.n):
        a += law.C[i, j] * state.x[j]
    for j in range(NY):
        a += law.D_u0[i, j] * state.ref[j] + law.D_r[i, j] * state.r[j]
    for j in range(NY):
        if j != 2:
            a += law.D_y[i, j] * state.y[j]
    return a


@inlined
def output(law, state):
    """u = u_0 + C x + D_r r + D_y y + offset, p.u., from the inputs set, before and after its
    limits. omega_u comes first, since column 3 feeds it back."""
    state.raw[1] = _row(law, state, 1) * law.loop
    state.now[1] = state.y[2] = limited(state.raw[1], law.low[1], law.high[1])
    for i in (0, 2):
        state.raw[i] = _row(law, state, i) + law.D_y[i, 2] * state.y[2]
        state.now[i] = limited(state.raw[i], law.low[i], law.high[i])


@inlined
def look(law, state, ref, y, u):
    """u[k] without a step."""
    set_inputs(law, state, ref, y)
    output(law, state)
    for i in range(NU):
        u[i] = state.now[i]


@inlined
def _leads_away(law, state):
    """Whether E_u moves away from v: a move towards v lets the current leave its limit."""
    move = law.one - law.one
    for i in range(law.n):
        if law.row[i] == 2:
            move += law.C[2, i] * (state.x_next[i] - state.x[i])
    return move * (state.u[2] - state.v_f[0]) > 0


@inlined
def advance(law, state):
    """x[k+1] = A x + B_r r + B_y y, with back-calculation W where the limits clamp u; the offset
    decays, and the trend follows u[k] - u[k-1]."""
    n = law.n
    for i in range(NU):
        excess = state.now[i] - state.raw[i]
        if law.inner == STIFF:  # its limits are beside the law's, but for the integrator of E_u
            if i == 2:
                excess += state.push
        elif i == 1 and law.inner != NONE:  # the power limiter moves omega_u too
            excess = state.omega - state.raw[i]
        if excess != 0:
            for j in range(n):
                state.x[j] += law.W[j, i] * excess
        state.offset[i] = faded(state.offset[i] * law.decay)
        change = state.now[i] - state.u[i] - state.trend[i]
        state.trend[i] = faded(state.trend[i] + law.follow * change)
        state.u[i] = state.now[i]
    for i in range(n):
        a = law.B_r[i, 0] * state.r[0]
        for j in range(1, NY):
            a += law.B_r[i, j] * state.r[j]
        for j in range(NY):
            a += law.B_y[i, j] * state.y[j]
        for j in range(n):
            a += law.A[i, j] * state.x[j]
        state.x_next[i] = a
    if law.freeze != 0 and state.limited != 0 and _leads_away(law, state):
        for i in range(n):  # the states of E_u stay
            if law.row[i] == 2:
                state.x_next[i] = state.x[i]
    for i in range(n):
        state.x[i] = faded(state.x_next[i])


@inlined
def step(law, state, ref, y, u):
    """One tick: u[k] into u, and the state to k+1.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``.
        ref, y: references and measurements, shape (5,), p.u.
        u: output, shape (3,), p.u.

    Fields of a record are the fastest for ref, y and u: numba counts references to an array
    atomically whenever it passes one on, but not to a part of a record.
    """
    look(law, state, ref, y, u)
    advance(law, state)


@inlined
def look_with_inner(law, state, ref, y, out):
    """The output of a tick with the inner stage: (i_u, omega_u, e_d, e_q) into out.

    Args:
        law, state, ref: as for ``step``.
        y: shape (11,), p.u.
        out: output, shape (4,), p.u.
    """
    take_measurements(state, y)
    set_inputs(law, state, ref, y)
    if law.k_pll > 0:  # omega_g is measured
        measure_frequency(law, state)
        state.ref[2] = state.r[2] = state.omega_pll
    output(law, state)
    shape(law, state)
    out[0], out[1], out[2], out[3] = state.now[0], state.omega, state.e_now[0], state.e_now[1]


@inlined
def advance_with_inner(law, state):
    """The state of law and stage to k+1."""
    advance(law, state)
    for k in range(2):
        state.e[k] = state.e_now[k]
