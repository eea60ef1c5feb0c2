"""The controller's tick with an inner stage, and with laws that measure and modulate themselves.

`control` calls it by an address, so that runs without such laws need not compile it.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import typeof, types

from gfm_runtime.by_address import address_of
from gfm_runtime.compiled import inlined
from gfm_runtime.controller import accept, change, go_safe, join, make_controller, next_law
from gfm_runtime.counts import align, go_on_with, measure, modulate
from gfm_runtime.impedance import make_impedance
from gfm_runtime.inner import settle_inner, take_measurements
from gfm_runtime.kernel import advance_with_inner, look_with_inner
from gfm_runtime.signals import N_LEGS, NU, NU_INNER, NY_INNER, Y_V_D, Y_V_Q
from gfm_runtime.states import BAD_SENSOR, BAD_U, RUNNING


@cache
def inner_tick(law: np.dtype[Any], state: np.dtype[Any]) -> int:
    """Compile, or load, the tick for laws of these types; returns its address."""
    row = np.empty(0)
    records = (
        make_controller(),
        np.empty(0, law),
        np.empty(0, state),
        make_impedance(1e-4, 1.0),
        row,
        row,
    )
    return address_of((types.CPointer(typeof(records)),), _tick_of)


def _tick_of(records: Any, a: float, b: float) -> None:
    ctl, laws, states, est, y, u = records[0]
    _control(ctl[0], laws, states, est, y, u)


@inlined
def _control(c, laws, states, est, y, u):
    """One tick in RUNNING; arguments as of ``control``."""
    counts, before = len(y) > NY_INNER, c.active
    if not (sense(c, laws[before], states[before], y) if counts else accept(c, y)):
        return
    _tick(c, laws, states, est, u)
    if counts:
        if c.active != before:
            go_on_with(states[c.active], states[before])
        if c.state == RUNNING:
            modulate(laws[c.active], states[c.active])
            for x in range(N_LEGS):
                u[NU_INNER + x] = int(states[c.active].compare[x])


@inlined
def sense(c, law, state, y):
    """Measure from the counts at the end of y (21,); whether all is plausible and in range."""
    if c.aligns:
        c.aligns = 0
        if c.joins:
            state.sensed[Y_V_D], state.sensed[Y_V_Q] = 1.0, 0.0
        align(law, state, y, NY_INNER)
    measure(law, state, y, NY_INNER)
    if state.suspect >= 0:
        go_safe(c, BAD_SENSOR, state.suspect)
        return False
    return accept(c, state.sensed)


@inlined
def _tick(c, laws, states, est, u):
    """A tick in p.u., from the y that ``c`` has accepted; other arguments as of ``control``."""
    if c.joins:
        c.joins = 0
        join(laws[c.active], states[c.active], c)
        take_measurements(states[c.active], c.y)
        settle_inner(laws[c.active], states[c.active], c.u[2], 0.0)
    k = next_law(c, est[0], c.y)
    if k >= 0:
        change(c, laws, states, k)
        take_measurements(states[k], c.y)
        settle_inner(laws[k], states[k], c.out[2], c.out[3])
    look_with_inner(laws[c.active], states[c.active], c.ref, c.y, c.out)
    for i in (1, 0, 2, 3):
        if not math.isfinite(c.out[i]):
            go_safe(c, BAD_U, i)
            return
    advance_with_inner(laws[c.active], states[c.active])
    for i in range(NU):
        c.u[i] = states[c.active].u[i]  # the law's own
    for i in range(NU_INNER):
        u[i] = c.out[i]
