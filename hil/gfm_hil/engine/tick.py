"""The rules of one tick, written once for the loop in process and the loops over a link.

Plant, tick k: ``sample`` y[k]; then ``apply_peer_state``, the state that came with u[k], and
``take`` u[k]. The plant goes on by one period before it takes u[k] if that is delayed, else after.
Controller, tick k: ``answer`` y[k] with u[k].
"""

from gfm_hil.engine.loop_records import ReturnReason
from gfm_hil.recording.recorder import record_sample
from gfm_plant import plant_command, plant_sample
from gfm_plant.names import CONTROLLER, MAY_START, SAFE_STATE
from gfm_plant.protection import start_condition, trip
from gfm_runtime.compiled import inlined
from gfm_runtime.controller import control, follow_plant
from gfm_runtime.states import READY, SAFE, STOPPED


@inlined
def sample(plant, i, y, row):
    """Measure y[k] of converter i and record it; returns the trip in force, 0 for none."""
    plant_sample(plant, i, y)
    record_sample(row, y, plant, i)
    return plant.st[i].trip


@inlined
def answer(ctl, laws, states, est, y, u, plant_tripped):
    """Compute u[k] from y[k]; a trip of the plant takes the controller to SAFE."""
    follow_plant(ctl, plant_tripped)
    control(ctl, laws, states, est, y, u)


@inlined
def apply_peer_state(plant, i, survives_trip, state):
    """What the state of converter i's controller asks of the plant: PEER_SAFE or PEER_STOPPED end
    the run.

    A run that ``survives_trip`` trips converter i instead when the controller is in SAFE.
    """
    if state == SAFE:
        if not survives_trip:
            return ReturnReason.PEER_SAFE
        trip(plant, i, CONTROLLER, SAFE_STATE)
    if state == STOPPED:
        return ReturnReason.PEER_STOPPED
    return ReturnReason.GO_ON


@inlined
def take(plant, i, u, tripped, state, fresh):
    """Hand u[k] to the D/A of converter i.

    Returns RESTORE, with u[k] not taken, if the plant was ``tripped`` and the controller is READY
    for a new start in a ``fresh`` frame. In a network the plant does not go back to its start; see
    ``asks_to_start``.
    """
    if tripped != 0 and state == READY and fresh and plant.net[0].joins == 0:
        return ReturnReason.RESTORE
    plant_command(plant, i, u)
    return ReturnReason.GO_ON


@inlined
def asks_to_start(plant, i, state):
    """Look, after the tick, whether converter i of a network, whose controller is in ``state``, is
    to start again; returns whether Python has to act on what it waits for (``waits``)."""
    s = plant.st[i]
    if plant.net[0].joins == 0 or s.trip == 0 or state != READY:
        return False
    before = s.waits
    s.waits = start_condition(plant, i)
    return s.waits == MAY_START or s.waits != before
