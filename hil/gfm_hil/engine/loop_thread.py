"""A compiled loop in a thread of its own, watched by the main thread, which receives Ctrl-C."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import Role
from gfm_hil.engine.drive import drive_controller, drive_plant
from gfm_hil.engine.loop_records import FLAGS, STOP
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link
from gfm_hil.links.frame import FrameReader
from gfm_hil.links.pump import ported
from gfm_hil.realtime.priority import stand_back
from gfm_hil.recording.parts import Part

_LOOK_S = 0.05


def run_loop(
    role: Role,
    bench: Bench,
    link: Link,
    part: Part,
    timeline: Timeline,
    t0_ns: int,
    stopped: Callable[[], bool],
    flags: NDArray[np.int64] | None = None,
) -> FrameReader:
    """Run one side of a scenario after the handshake; returns its frame counters.

    The thread inherits processor and priority from the caller. The caller then steps back to
    ordinary priority and only looks, a few times a second, whether to stop and what to write down.
    A link without a port gets a thread that pumps its messages.

    Raises:
        PeerLost: a model in place of the law does not answer; its thread is left behind.

    Args:
        flags: shape (FLAGS,), what other threads tell the loop, see
            ``gfm_hil.engine.loop_records``.
    """
    if flags is None:
        flags = np.zeros(FLAGS, np.int64)
    link = ported(link)
    start, stop = (getattr(link, name, _nothing) for name in ("start", "stop"))
    start()
    found: list[FrameReader] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            drive = drive_plant if role == "plant" else drive_controller
            found.append(drive(bench, link, part, timeline, t0_ns, flags))
        except BaseException as problem:  # the caller's thread raises it
            failed.append(problem)

    timeline.put_off = True
    thread = threading.Thread(target=work, name=f"{role}-loop", daemon=True)
    thread.start()
    stand_back()
    try:
        while thread.is_alive():
            thread.join(_LOOK_S)
            timeline.flush()
            flags[STOP] = stopped() or bool(timeline.failed)
            if bench.model is not None:
                bench.model.watch(timeline, bench.scenario.link.peer_timeout_s / 2)
    finally:  # also after a second Ctrl-C: the thread must end before its arrays go
        flags[STOP] = 1
        while thread.is_alive() and not (bench.model is not None and bench.model.given_up):
            with contextlib.suppress(KeyboardInterrupt):
                thread.join()
        timeline.put_off = False
        stop()
    if failed:
        raise failed[0]
    return found[0]


def _nothing() -> None:
    """The start and the stop of a link that has neither method."""
