"""What a compiled loop remembers from one call to the next, and why it came back."""

from __future__ import annotations

import numpy as np

#: why a loop returned
DONE, STOPPED_HERE, LOOK, PEER_SAFE, PEER_STOPPED, SILENT, LATE, EVENT = range(8)

loop_dtype = np.dtype(
    [
        ("realtime", "i8"),
        ("tick", "i8"),  # plant: the next one; controller: the last one received, -1 before
        ("t0", "i8"),  # of tick 0, ns
        ("T", "i8"),  # sampling time, ns
        ("patience", "i8"),  # silence after which the other side is gone, ns
        ("hold", "i8"),  # misses in a row that the plant allows
        ("late", "i8"),  # misses in a row
        ("misses", "i8"),
        ("heard", "i8"),  # when the last message came, ns
        ("pending", "i8"),  # a frame was taken but not yet computed
        ("done", "i8"),  # ticks computed
        ("expected", "f8"),  # arrival of the next frame by the phase lock, ns after t0
        ("period", "f8"),  # of the other side's ticks by our clock, ns
    ],
    align=True,
)


def make_loop(
    realtime: bool, tick: int, t0_ns: int, T_s: float, patience_s: float, hold: int
) -> np.ndarray:
    """A loop before its first tick; see ``loop_dtype``."""
    loop = np.zeros(1, loop_dtype)
    loop["realtime"], loop["tick"], loop["t0"], loop["hold"] = realtime, tick, t0_ns, hold
    loop["T"] = loop["period"] = round(T_s * 1e9)
    loop["patience"] = int(patience_s * 1e9)
    return loop
