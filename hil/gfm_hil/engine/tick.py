"""The rules of one tick, written once for the loop in process and the loops over a link.

Plant, tick k: ``sample`` y[k]; then ``obey`` the state that came with u[k] and ``advance`` under
u[k]. Controller, tick k: ``answer`` y[k] with u[k].
"""

from __future__ import annotations

from gfm_hil.engine.loop_records import Why
from gfm_hil.recording.recorder import record_sample
from gfm_plant import plant_command, plant_sample, plant_step
from gfm_plant.names import CONTROLLER, SAFE_STATE
from gfm_plant.protection import trip
from gfm_runtime.compiled import inlined
from gfm_runtime.controller import control, follow_plant
from gfm_runtime.states import READY, SAFE, STOPPED


@inlined
def sample(par, st, y, row):
    """Measure y[k] and record it; returns the trip in force, 0 for none."""
    plant_sample(par, st, y)
    record_sample(row, y, par, st)
    return st[0].trip


@inlined
def answer(ctl, laws, states, est, y, u, plant_tripped):
    """Compute u[k] from y[k]; a trip of the plant takes the controller to SAFE."""
    follow_plant(ctl, plant_tripped)
    control(ctl, laws, states, est, y, u)


@inlined
def obey(par, st, waits, state):
    """What the controller's state asks of the plant: PEER_SAFE or PEER_STOPPED end the run.

    A plant that ``waits`` for a reset trips instead when the controller is in SAFE.
    """
    if state == SAFE:
        if not waits:
            return Why.PEER_SAFE
        trip(par[0], st[0], CONTROLLER, SAFE_STATE)
    if state == STOPPED:
        return Why.PEER_STOPPED
    return Why.GO_ON


@inlined
def advance(par, st, u, delayed, tripped, state, fresh):
    """Hand u[k] to the D/A and go on by one period; a ``delayed`` plant has done so already.

    Returns RESTORE, with u[k] not taken, if the plant was ``tripped`` and the controller is READY
    for a new start in a ``fresh`` frame.
    """
    if tripped != 0 and state == READY and fresh:
        return Why.RESTORE
    plant_command(par, st, u)
    if not delayed:
        plant_step(par, st)
    return Why.GO_ON
