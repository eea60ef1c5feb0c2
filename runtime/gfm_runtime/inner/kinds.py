"""All kinds of inner stage, and the tick of one.

A law gives the internal voltage E_u and the frequency omega_u. Without an inner stage the bridge
produces E_u itself, as in the paper. With one, the measured currents and voltages of the filter
(i, v, i_o in the converter's dq frame) and E = E_u + j 0 give a reference current i*, which the
stage limits, and a current loop gives the bridge's voltage e = e_d + j e_q.

A kind of stage is a file: its options, its i* in a tick, and its line in ``Inner``.
"""

import math
from typing import Annotated, Any, get_args

import numpy as np
from pydantic import Field

from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.inner.dual_sequence import DualSequence, dual_sequence
from gfm_runtime.inner.grid_following import (
    GridFollowingStage,
    grid_following,
    settle_following,
    turn_frame,
)
from gfm_runtime.inner.stage import (
    I_D,
    I_OD,
    I_OQ,
    I_Q,
    LEAST_V,
    OMEGA,
    P_HIGH,
    P_LOW,
    V_D,
    V_DC,
    V_Q,
    InnerStage,
    P,
    current_loop,
    faded,
    follow,
    limit_current,
    limit_power,
    take_measurements,
)
from gfm_runtime.inner.stiff_source import StiffSource, follow_powers, held_voltage, stiff_source
from gfm_runtime.inner.virtual_stator import VirtualStator, stator
from gfm_runtime.inner.voltage_loop import (
    Cascaded,
    ThresholdImpedance,
    settle_voltage_loop,
    voltage_loop,
)
from gfm_runtime.signals import NU

Inner = Annotated[
    VirtualStator | Cascaded | ThresholdImpedance | DualSequence | StiffSource | GridFollowingStage,
    Field(discriminator="type"),
]

STAGES: dict[str, type[InnerStage]] = {
    str(one.model_fields["type"].default): one for one in get_args(get_args(Inner)[0])
}
KINDS = {name: code for code, name in enumerate(("none", *STAGES))}
NONE, STATOR, DUAL = KINDS["none"], KINDS["virtual-stator"], KINDS["dual-sequence"]
STIFF, FOLLOWING = KINDS["stiff-source"], KINDS["grid-following"]

#: integers of the stage in ``law_dtype``: places in ``KINDS`` and ``PRIORITIES``, and yes or no
INNER_NUMBERS = [("inner", "i8"), ("priority", "i8"), ("freeze", "i8")]
#: constants that a law has without a stage too, and those of the kinds, in the law's precision
_OF_ALL = ("one", "half_turn", "least_v")
INNER_CONSTANTS = (
    *dict.fromkeys(
        (*_OF_ALL, *(name for one in STAGES.values() for name in one().constants(1.0, 1.0)))
    ),
)


def inner_fields(f: np.dtype[Any]) -> list[Any]:
    """The inner stage's constants in ``law_dtype``."""
    return [(name, f) for name in INNER_CONSTANTS]


def pack_inner(stage: InnerStage | None, rec: Any, T_s: float, omega_b: float) -> None:
    """Fill the fields ``INNER_NUMBERS`` and ``INNER_CONSTANTS`` of a law's record, which are 0.

    Args:
        stage: None for a law without one.
        T_s: sampling time, s.
        omega_b: base frequency of the converter, rad/s.
    """
    rec["one"], rec["half_turn"], rec["least_v"] = 1.0, omega_b * T_s / 2, LEAST_V
    if stage is not None:
        rec["inner"] = KINDS[stage.kind]
        stage.pack(rec, T_s, omega_b)


@inlined
def shape(law, state):
    """One tick of the inner stage: the bridge's voltage e from E_u, and omega_u after the power
    limiter, p.u.

    Args:
        law, state: records of ``law_dtype`` and ``state_dtype``, between ``output`` and ``advance``
            of the law; ``take_measurements`` was called.
    """
    E_d, E_q = state.now[2] + state.away[0], state.away[1]
    state.omega = state.now[1]
    if law.inner == NONE:
        state.limited = 0
        state.e_now[0], state.e_now[1] = E_d, E_q
    else:
        p = state.m[P]
        follow(law, state)
        if law.inner == STIFF:
            follow_powers(law, state)
            p = state.slow[0]
        if law.P_max < P_HIGH or law.P_min > P_LOW:
            limit_power(law, state, p)
        if law.inner == STATOR:
            stator(law, state, E_d, E_q)
            limit_current(law, state)
        elif law.inner == DUAL:
            dual_sequence(law, state, E_d, E_q)
        elif law.inner == STIFF:
            stiff_source(law, state)
        elif law.inner == FOLLOWING:
            grid_following(law, state)
        else:
            voltage_loop(law, state, E_d, E_q)
        if law.inner != DUAL and law.inner != STIFF:
            current_loop(law, state)
        if law.inner == FOLLOWING:
            turn_frame(law, state)
        most = law.m * state.m[V_DC]
        size = state.e_now[0] * state.e_now[0] + state.e_now[1] * state.e_now[1]
        if size > most * most:  # the limit of the modulation
            scale = most / math.sqrt(size)
            state.e_now[0] *= scale
            state.e_now[1] *= scale
    for k in range(2):
        state.away[k] = faded(state.away[k] * law.decay)


@inlined
def settle_inner(law, state, e_d, e_q):
    """The state of the stage with which the bridge's voltage goes on at e: at the start, and when
    another law takes over. What the structure cannot absorb goes into away.

    Args:
        law, state: as for ``shape``; ``state.now`` is the law's output.
        e_d, e_q: p.u.
    """
    m = state.m
    state.omega = state.omega_pll = m[OMEGA] if law.inner == FOLLOWING else state.now[1]
    size = math.sqrt(m[V_D] * m[V_D] + m[V_Q] * m[V_Q])
    state.pll[0], state.pll[1] = law.one, 0
    if size > law.least_v:
        state.pll[0], state.pll[1] = m[V_D] / size, m[V_Q] / size
    state.x_high, state.x_low, state.limited, state.push = 0, 0, 0, 0
    state.slow[0], state.slow[1] = m[P], m[V_Q] * m[I_OD] - m[V_D] * m[I_OQ]
    of = max(size, law.least_v)
    state.level[1] = (m[V_D] * m[I_OD] + m[V_Q] * m[I_OQ]) / of
    state.level[0], state.window[0], state.window[1] = size, law.angle_max, -law.angle_max
    for k in range(2):
        state.v_f[k], state.i_f[k], state.i_ref[k] = m[V_D + k], m[I_D + k], m[I_D + k]
        state.x_c[k] = state.x_v[k] = state.i_n[k] = state.E_n[k] = state.x_Q[k] = 0
    state.e[0], state.e[1] = e_d, e_q
    need_d, need_q = state.e[0], state.e[1]  # in the law's own precision
    if law.inner != NONE and law.inner != STIFF:
        X = state.omega * law.L_f
        lack_d, lack_q = need_d - m[V_D] + X * m[I_Q], need_q - m[V_Q] - X * m[I_D]
        if law.T_k_ci > 0:
            state.x_c[0], state.x_c[1] = lack_d, lack_q
        else:
            state.i_ref[0] += lack_d / law.k_c
            state.i_ref[1] += lack_q / law.k_c
        through_d, through_q = state.i_ref[0], state.i_ref[1]
        state.x_v[0], state.x_v[1] = through_d, through_q
        state.i_p[0], state.i_p[1] = through_d, through_q
        state.drop[0] = state.drop[1] = 0
        if law.inner != STATOR and law.inner != DUAL and law.inner != FOLLOWING:
            through_d, through_q = settle_voltage_loop(law, state)
        X = state.omega * law.X_v
        need_d = m[V_D] + law.R_v * through_d - X * through_q + state.drop[0]
        need_q = m[V_Q] + law.R_v * through_q + X * through_d + state.drop[1]
    E = state.now[2]
    if law.inner == STIFF:
        E = held_voltage(law, state)
    if law.inner == FOLLOWING:
        settle_following(law, state)
    else:
        state.away[0], state.away[1] = need_d - E, need_q
    state.E_p[0], state.E_p[1] = need_d, need_q


@compiled
def settle(law, state, u, y, e_d, e_q):
    """``settle_inner`` from Python: one-element arrays of the records, and y (11,), p.u."""
    take_measurements(state[0], y)
    for i in range(NU):
        state[0].now[i] = u[i]
    settle_inner(law[0], state[0], e_d, e_q)
