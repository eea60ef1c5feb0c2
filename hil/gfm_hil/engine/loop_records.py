"""What a compiled loop remembers from one call to the next, and why it came back."""

from __future__ import annotations

import numpy as np

from gfm_hil.scenario.model import Scenario
from gfm_runtime.signals import NU
from gfm_runtime.states import RUNNING

#: why a loop returned
(
    DONE, STOPPED_HERE, LOOK, PEER_SAFE, PEER_STOPPED, SILENT, LATE, EVENT, BELL, RESTORE, GONE,
) = range(11)  # fmt: skip

#: what other threads tell a loop, int64: to come back for good, and, by counting up, for a moment
STOP, RING, TOLD = range(3)

loop_dtype = np.dtype(
    [
        ("realtime", "i8"),
        ("clock_every", "i8"),  # at first, looks in vain between two looks at the clock, 25 ns
        ("looks", "i8"),  # lockstep: looks in vain after which it may sleep
        ("tick", "i8"),  # plant: the next one; controller: the last one received, -1 before
        ("t0", "i8"),  # of tick 0, ns
        ("T", "i8"),  # sampling time, ns
        ("patience", "i8"),  # silence after which the other side is gone, ns
        ("hold", "i8"),  # misses in a row that the plant allows
        ("extrapolate", "i8"),  # plant: misses in a row over which u goes on along its trend
        ("repeat", "i8"),  # lockstep: silence after which the plant sends y again, ns
        ("repeats", "i8"),  # how often it did
        ("unrested", "i8"),  # plant: ticks in a row without a sleep
        ("late", "i8"),  # misses in a row
        ("misses", "i8"),
        ("heard", "i8"),  # when the last message came, ns
        ("pending", "i8"),  # a frame was taken but not yet computed
        ("done", "i8"),  # ticks computed
        ("bell", "i8"),  # as last heard
        ("waits", "i8"),  # after a trip or in SAFE: for a reset, instead of ending the run
        ("seen", "i8"),  # controller: the state that was last come back with
        ("u_last", "f8", (NU,)),  # the two newest u that came in time
        ("u_before", "f8", (NU,)),
        ("phase", "f8"),  # controller: earliest arrivals of frames after t0 + k T, ns
    ],
    align=True,
)


_CLOCK_EVERY = 64


def make_loop(scenario: Scenario, tick: int, t0_ns: int) -> np.ndarray:
    """A scenario's loop before its first tick; see ``loop_dtype``."""
    loop = np.zeros(1, loop_dtype)
    link, policy = scenario.link, scenario.late_policy
    loop["realtime"], loop["tick"], loop["t0"] = scenario.mode == "realtime", tick, t0_ns
    loop["clock_every"] = 1 if scenario.mode == "realtime" else _CLOCK_EVERY
    loop["waits"], loop["seen"] = scenario.after_trip == "wait", RUNNING
    loop["hold"], loop["extrapolate"] = policy.hold, policy.extrapolate
    loop["T"] = round(scenario.T_s * 1e9)
    loop["patience"], loop["repeat"] = int(link.peer_timeout_s * 1e9), int(link.repeat_s * 1e9)
    return loop
