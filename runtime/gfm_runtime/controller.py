"""The controller's tick: checks, set-points, the active law, changes of law, the safe state.

All variables are in one record of ``controller_dtype`` and in the records of the laws. A tick is
therefore one njit call, the same for every link, in lockstep and in real time.
States: INIT -> READY -> RUNNING -> SAFE (latched) -> STOPPED. In SAFE the outputs stay at the
last good u, every frame carries the state, and the plant blocks the bridge. If the scenario waits
after that, a reset takes the controller to READY, at rest. The plant then returns to its own start
and stops sending SAFE, and the controller goes to RUNNING. In a network the others have gone on:
there the controller begins with the voltage and the frequency that it measures.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.by_address import call_at, on_stack
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.impedance import estimate
from gfm_runtime.kernel import advance, look
from gfm_runtime.signals import NU, NU_INNER, NY, NY_INNER, SET_HIGH, SET_LOW, SET_REF, group
from gfm_runtime.states import BAD_U, BAD_Y, PLANT_TRIP, READY, RUNNING, SAFE, STALE
from gfm_runtime.switchover import change_law, settle_into

MAX_STAGES = 8

controller_dtype = np.dtype(
    [
        ("state", "i8"),
        ("reason", "i8"),
        ("channel", "i8"),  # which y, u or sensor was bad
        ("active", "i8"),  # index into the laws
        ("request", "i8"),  # index to change to at the next tick, or -1
        ("changes", "i8"),
        ("joins", "i8"),  # the first tick in RUNNING begins with what is measured, see ``measured``
        # likewise, with laws that measure: their frame takes its angle from the measured voltage
        ("aligns", "i8"),
        ("bump", "f8"),  # of the last change, p.u.
        ("stale", "i8"),  # ticks in a row without a fresh y
        ("hold", "i8"),  # how many of them are allowed
        ("ref", "f8", (NY,)),
        ("ref_target", "f8", (NY,)),
        ("ref_rate", "f8", (NY,)),  # p.u. per tick; 0 is a step
        ("y", "f8", (NY_INNER,)),  # of this tick: the kernel takes fields of a record
        ("u", "f8", (NU,)),
        ("ref_seen", "f8", (NY,)),  # with which a law joins, see ``join``
        ("out", "f8", (NU_INNER,)),  # with an inner stage: what goes to the bridge
        ("y_low", "f8", (NY_INNER,)),
        ("y_high", "f8", (NY_INNER,)),
        # gain scheduling: how many points, and the law of each
        ("stages", "i8"),
        ("stage_law", "i8", (MAX_STAGES,)),
        ("by_V", "i8"),  # whether the points are voltages; else reactances of the grid
        ("above", "f8", (MAX_STAGES,)),  # the next point is taken above this value, p.u.
        ("below", "f8", (MAX_STAGES,)),  # and left again below this one, p.u.
        ("dwell", "i8"),  # least ticks between two changes
        ("since", "i8"),  # ticks since the last change, until the next one is allowed
        ("inner_tick", "i8"),  # address of the tick with an inner stage, see `inner_tick`
    ],
    align=True,
)


def make_controller(hold: int = 0) -> NDArray[Any]:
    """A controller record in INIT with the signal table's ranges and default references.

    Args:
        hold: ticks in a row without a fresh measurement before the safe state.
    """
    out = np.zeros(1, controller_dtype)
    rec = out[0]
    rec["request"], rec["hold"] = -1, hold
    rec["ref"] = rec["ref_target"] = [s.default for s in group("ref")]
    measured = (*group("y"), *group("y_inner"))
    rec["y_low"] = [s.low for s in measured]
    rec["y_high"] = [s.high for s in measured]
    return out


def set_reference(ctl: NDArray[Any], index: int, value: float, per_tick: float = 0.0) -> None:
    """New target of one reference (p.u.); reached in steps of ``per_tick``, 0 at once."""
    ctl["ref_target"][0, index] = value
    ctl["ref_rate"][0, index] = abs(per_tick)


@compiled
def go_safe(ctl, reason, channel):
    """Go to SAFE for a reason and a channel of it; the first reason stays."""
    if ctl.state != SAFE:
        ctl.state, ctl.reason, ctl.channel = SAFE, reason, channel


@compiled
def missed(ctl):
    """Count a tick without a fresh measurement; SAFE when there were too many in a row.

    ``ctl`` is the one-element array of ``controller_dtype``, as for ``control``.
    """
    c = ctl[0]
    c.stale += 1
    if c.stale > c.hold:
        go_safe(c, STALE, -1)


@compiled
def follow_plant(ctl, tripped):
    """Use the plant's state from its frame: a trip takes a RUNNING controller to SAFE, and a plant
    that runs takes a READY controller to RUNNING."""
    c = ctl[0]
    if tripped:
        if c.state == RUNNING:
            go_safe(c, PLANT_TRIP, -1)
    elif c.state == READY:
        c.state = RUNNING


@inlined
def choose(c, now, at, above, below):
    """The stage for a reactance or a voltage, p.u., with hysteresis and a least time between
    changes. A voltage that falls changes it at once, one that rises after that time above."""
    stage = now
    if c.since <= c.dwell:
        c.since += 1
    if c.by_V and at <= above[now]:
        c.since = 0
    if c.since > c.dwell:
        while stage + 1 < c.stages and above[stage] < at:
            stage += 1
    if c.by_V or c.since > c.dwell:
        while stage > 0 and below[stage - 1] > at:
            stage -= 1
    return stage


@compiled
def _schedule(c, est, y):
    """Request the stage for the voltage, or for the estimated reactance."""
    at = y[4] if c.by_V else estimate(est, y[1], y[2], y[4])
    now = 0
    for k in range(c.stages):
        if c.stage_law[k] == c.active:
            now = k
    stage = choose(c, now, at, c.above, c.below)
    if stage != now:
        c.request, c.since = c.stage_law[stage], 0


@inlined
def take_set_points(c, y, own):
    """Take the set-points of a plant controller, which y has from place ``own`` on, as references
    from this tick on: those that are numbers within the signal table's range."""
    for j in range(len(y) - own):
        value = y[own + j]
        if SET_LOW[j] <= value <= SET_HIGH[j]:
            c.ref_target[SET_REF[j]], c.ref_rate[SET_REF[j]] = value, 0.0


@inlined
def accept(c, y):
    """Check y[k] and keep it in ``c.y``, and move the references by one tick.

    Returns:
        Whether y is finite and in range; else the controller is in SAFE.
    """
    for j in range(len(y)):
        if not (c.y_low[j] <= y[j] <= c.y_high[j]):
            go_safe(c, BAD_Y, j)
            return False
        c.y[j] = y[j]
    move_references(c)
    return True


@inlined
def move_references(c):
    """Move the references by one tick in which y is fresh."""
    c.stale = 0
    for j in range(NY):
        away = c.ref_target[j] - c.ref[j]
        if c.ref_rate[j] == 0.0 or abs(away) <= c.ref_rate[j]:
            c.ref[j] = c.ref_target[j]
        else:
            c.ref[j] += math.copysign(c.ref_rate[j], away)


@inlined
def measured(y, u):
    """Write u (3,) for a bridge without current on a capacitor that others keep charged, p.u.: its
    frequency and its voltage."""
    u[0], u[1], u[2] = 0.0, y[2], y[4]


@inlined
def join(law, state, c):
    """Set the law's state so that its output begins with what is measured."""
    measured(c.y, c.u)
    for j in range(NY):
        c.ref_seen[j] = c.ref[j]
        if j < NU:
            state.trend[j] = 0
    if law.k_pll > 0.0:  # of an inner stage
        c.ref_seen[2] = c.u[1]
    settle_into(law, state, c.ref_seen, c.y, c.u, state.trend)


@inlined
def next_law(c, est, y):
    """The law to which this tick changes, as requested or by the schedule; -1 if it stays."""
    if c.stages > 0:
        _schedule(c, est, y)
    k, c.request = c.request, -1
    return -1 if k == c.active else k


@inlined
def change(c, laws, states, k):
    """Change to law k, bumpless."""
    c.bump = change_law(laws[c.active], states[c.active], laws[k], states[k], c.ref, c.y, c.u)
    c.active, c.changes = k, c.changes + 1


@compiled
def bad_output(ctl, channel):
    """SAFE, because output ``channel`` is not finite."""
    go_safe(ctl[0], BAD_U, channel)


@inlined
def control(ctl, laws, states, est, y, u):
    """One tick: y[k] in, u[k] out.

    Args:
        ctl, est: one-element arrays of ``controller_dtype`` and ``impedance_dtype``.
        laws, states: arrays of ``law_dtype`` and ``state_dtype``, one element a law.
        y: measurements, shape (5,), or (11,) with an inner stage, p.u.; (21,) for laws that measure
            themselves, from the counts at its end.
        u: output, u[k], shape (3,), or (4,) with an inner stage, p.u.; (7,) for laws that modulate
            too, with compare counts at its end. Unchanged in SAFE.
    """
    c = ctl[0]
    if c.state != RUNNING:
        return
    if len(y) > NY:
        call_at(c.inner_tick, on_stack((ctl, laws, states, est, y, u)), 0.0, 0.0)
    elif accept(c, y):
        _tick(c, laws, states, est, u)


@inlined
def _tick(c, laws, states, est, u):
    """A tick from the y that ``c`` has accepted; other arguments as of ``control``."""
    if c.joins:
        c.joins = 0
        join(laws[c.active], states[c.active], c)
    k = next_law(c, est[0], c.y)
    if k >= 0:
        change(c, laws, states, k)
    look(laws[c.active], states[c.active], c.ref, c.y, c.u)
    for i in (1, 0, 2):  # omega_u first: column 3 takes it to the others
        if not math.isfinite(c.u[i]):
            go_safe(c, BAD_U, i)
            return
    advance(laws[c.active], states[c.active])
    for i in range(NU):
        u[i] = c.u[i]
