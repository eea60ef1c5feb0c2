"""What a compiled loop works on, what it remembers from call to call, and why it returns."""

import math
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import Role
from gfm_hil.links.frame import LAST_TIMES, LONGEST_JUMP, FrameReader
from gfm_hil.scenario import Scenario
from gfm_runtime.signals import NU_COUNTS, NY_MOST
from gfm_runtime.states import RUNNING, STOPPED


class ReturnReason(IntEnum):
    """The reason for which a compiled loop returned."""

    GO_ON = 0  #: only between compiled functions: there is no reason to return
    DONE = 1  #: plant: it reached the tick it was to run to
    STOPPED_HERE = 2  #: this process was told to stop
    CHANGED = 3  #: the law, the controller's state or the plant's protection changed
    PEER_SAFE = 4  #: the other side is in SAFE, and the run does not wait for a reset
    PEER_STOPPED = 5  #: the other side left
    SILENT = 6  #: nothing new came for ``link.peer_timeout_s``
    LATE = 7  #: plant, real time: no fresh u for longer than ``late_policy.hold``
    EVENT = 8  #: controller: an event is due in the next tick
    WOKEN = 9  #: another thread has something to be carried out
    RESTORE = 10  #: plant: tripped, and the controller is READY: back to the start
    GONE = 11  #: the link itself is gone


#: Indices of ``flags``, int64, by which other threads speak to a loop: a number other than 0 in
#: STOP ends it; it returns once whenever the number in WAKE has changed.
STOP, WAKE, FLAGS = range(3)

loop_dtype = np.dtype(
    [
        ("realtime", "i8"),
        ("clock_every", "i8"),  # reads of the link between two reads of the clock, at first
        ("spin_limit", "i8"),  # lockstep: empty reads after which the loop may sleep
        ("tick", "i8"),  # plant: the next one; controller: the last one computed, -1 before
        ("every", "i8"),  # ticks to an exchange of y and u
        ("at_once", "i8"),  # values that a frame puts into y or u when it comes: all, or none
        ("received", "i8"),  # controller: tick of the last y
        ("left", "i8"),  # controller, every > 1: the plant has left after tick ``received``
        ("ahead", "i8"),  # plant, every > 1: tick of the newest u, -1 before the first
        ("acting", "i8"),  # plant, every > 1: tick of the u that acts, -1 before the first
        ("u_ahead", "f8", (NU_COUNTS,)),
        ("t0", "i8"),  # of tick 0, ns
        ("T", "i8"),  # sampling time, ns
        ("patience", "i8"),  # silence after which the other side is gone, ns
        ("hold", "i8"),  # misses in a row that the plant allows
        ("extrapolate", "i8"),  # plant: misses in a row over which u continues its trend
        ("repeat", "i8"),  # lockstep: silence after which the plant sends y again, ns
        ("repeats", "i8"),  # lockstep: how often the plant has sent y again
        ("unrested", "i8"),  # plant: ticks in a row without a sleep
        ("late", "i8"),  # misses in a row
        ("misses", "i8"),
        ("heard", "i8"),  # when the last newer frame came, ns
        ("pending", "i8"),  # the controller took a frame and has not computed its tick yet
        ("done", "i8"),  # ticks computed
        ("woken", "i8"),  # ``flags[WAKE]`` as last seen
        ("survives_trip", "i8"),  # after a trip or in SAFE, instead of ending the run
        ("others", "i8"),  # plant: it has other converters, which go on if this controller is lost
        ("came", "i8"),  # plant: whether u[k] came in time, late or not at all
        ("tripped", "i8"),  # plant: the converter's trip when y[k] was measured
        ("unseen", "i8"),  # plant: the tick whose u arrives at the next reading of the clock
        ("lost", "f8"),  # plant: the trip after which it waits for the controller no more, or 0
        ("seen", "i8"),  # controller: the state with which it last returned
        ("u_last", "f8", (NU_COUNTS,)),  # the two newest u that came in time
        ("u_before", "f8", (NU_COUNTS,)),
        ("phase", "f8"),  # controller: earliest arrivals of frames after t0 + k T, ns
    ],
    align=True,
)


class LinkEnd(NamedTuple):
    """One end of a link as the loops use it: ``gfm_hil.links.Port`` and the frames' buffers."""

    # send, receive, patient, handle, spins: of the port
    send: Any
    receive: Any
    patient: Any
    handle: NDArray[np.int64]
    spins: int
    out: tuple[Any, Any, Any]  # sequence, record and bytes of the frame to send
    into: tuple[Any, Any]  # record and bytes of a frame received
    reader: NDArray[Any]  # counters of what was received, see ``gfm_hil.links.frame``


class Records(NamedTuple):
    """What a loop writes, whichever role it has."""

    loop: NDArray[Any]  # one element of ``loop_dtype``
    flags: NDArray[np.int64]  # shape (FLAGS,), int64, written by other threads
    # y, u: measurements (5,) and inputs (3,) of the current tick, (11,) and (4,) with an inner
    # stage, (21,) and (7,) with counts; p.u. and counts. y_sent: the memory of y, and after it the
    # set-points of a plant controller, if there is one
    y: NDArray[np.float64]
    y_sent: NDArray[np.float64]
    u: NDArray[np.float64]
    # rows, times, progress: of the recording's part
    rows: NDArray[np.float64]
    times: NDArray[np.int64]
    progress: NDArray[np.int64]
    flows: NDArray[np.float64]  # of the network, of that part; (ticks, 0) if it has none
    # plan, kept: of the trace that is replayed, see ``gfm_hil.engine.replay``
    plan: NDArray[np.int64]
    kept: NDArray[np.float64]


class Side(NamedTuple):
    """What the plant's loop has of one converter: its end of the link, and what it writes."""

    end: LinkEnd
    records: Records


class ControllerRecords(NamedTuple):
    """The controller's records, see ``gfm_runtime.controller``."""

    ctl: NDArray[Any]
    laws: NDArray[Any]
    states: NDArray[Any]
    est: NDArray[Any]


_CLOCK_EVERY = 64


def make_loop(scenario: Scenario, tick: int, t0_ns: int, hold: int, every: int = 1) -> np.ndarray:
    """A scenario's loop before its first tick; see ``loop_dtype``."""
    loop = np.zeros(1, loop_dtype)
    link = scenario.link
    loop["realtime"], loop["tick"], loop["t0"] = scenario.mode == "realtime", tick, t0_ns
    loop["clock_every"] = 1 if scenario.mode == "realtime" else _CLOCK_EVERY
    loop["survives_trip"], loop["others"] = scenario.survives_trips, scenario.network is not None
    loop["every"], loop["at_once"] = every, NY_MOST if every == 1 else 0
    loop["received"], loop["ahead"], loop["acting"] = tick, -1, -1
    loop["seen"], loop["unseen"] = RUNNING, -1
    loop["hold"], loop["extrapolate"] = hold, scenario.late_policy.extrapolate
    loop["T"] = round(scenario.T_s * 1e9)
    loop["patience"] = int(scenario.peer_timeout_s * 1e9)
    loop["repeat"] = int(link.repeat_s * 1e9)
    if tick < 0 and scenario.mode == "lockstep" and scenario.network is not None:
        loop["patience"] *= 2  # the plant may wait for another controller, and then goes on
    return loop


def limited_reader(role: Role, scenario: Scenario, hold: int = 0, every: int = 1) -> FrameReader:
    """The reader of one side's frames, with the limits that its scenario sets.

    In lockstep the sides wait for each other, so an exchange comes after the one before. In real
    time a gap of more ticks than fit into ``link.peer_timeout_s`` means that the peer is gone. The
    plant's loop writes its own tick into ``newest`` at every tick.

    Args:
        hold: of the plant in real time: how many ticks late a u may be.
        every: ticks to an exchange.
    """
    lockstep, plant = scenario.mode == "lockstep", role == "plant"
    gap = 0 if lockstep else math.ceil(scenario.peer_timeout_s / scenario.T_s)
    delta = gap + every
    asked = math.ceil(min(scenario.peer_timeout_s / scenario.link.repeat_s, LONGEST_JUMP))
    limits = {
        "delta": delta,
        "jump": min(delta + asked + LAST_TIMES, LONGEST_JUMP),
        "again": asked if lockstep else 0,
        "every": every,
    }
    if not plant:
        limits["newest"] = scenario.ticks - 1
    elif not lockstep:
        limits["behind"] = hold + (2 * every - 1 if every > 1 else 0)
    if scenario.survives_trips:
        limits["leaving"] = STOPPED
    return FrameReader("u" if plant else "y", scenario.frame_signals, **limits)
