"""A compiled loop in a thread of its own, watched by the main thread, which receives Ctrl-C."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import Role
from gfm_hil.engine.drive import Share, drive_controller, drive_plant
from gfm_hil.engine.loop_records import FLAGS, STOP
from gfm_hil.links.frame import FrameReader
from gfm_hil.links.pump import ported
from gfm_hil.realtime.priority import restore_priority

_LOOK_S = 0.05


def run_loop(
    role: Role,
    shares: Sequence[Share],
    t0_ns: int,
    stopped: Callable[[], bool],
    flags: NDArray[np.int64] | None = None,
) -> list[FrameReader]:
    """Run one side of a scenario after the handshakes; returns its frame counters.

    The thread inherits processor and priority from the caller. The caller then steps back to
    ordinary priority and only looks, a few times a second, whether to stop and what to write down.
    A link without a port gets a thread that pumps its messages.

    Raises:
        PeerLost: an external controller does not answer; its thread is left behind.

    Args:
        shares: of the controller one, of the plant one for each converter.
        flags: shape (FLAGS,), what other threads tell the loop, see
            ``gfm_hil.engine.loop_records``.
    """
    if flags is None:
        flags = np.zeros(FLAGS, np.int64)
    shares = [share._replace(link=ported(share.link)) for share in shares]
    timelines = [share.timeline for share in shares]
    external = shares[0].bench.external if role == "controller" else None
    for share in shares:
        getattr(share.link, "start", _nothing)()
    found: list[FrameReader] = []
    failed: list[BaseException] = []

    def work() -> None:
        try:
            if role == "plant":
                found.extend(drive_plant(shares, t0_ns, flags))
            else:
                found.append(drive_controller(shares[0], t0_ns, flags))
        except BaseException as problem:  # the caller's thread raises it
            failed.append(problem)

    for timeline in timelines:
        timeline.put_off = True
    thread = threading.Thread(target=work, name=f"{role}-loop", daemon=True)
    thread.start()
    restore_priority()
    try:
        while thread.is_alive():
            thread.join(_LOOK_S)
            for timeline in timelines:
                timeline.flush()
            flags[STOP] = stopped() or any(timeline.failed for timeline in timelines)
            if external is not None:
                external.watch(timelines[0].end, shares[0].bench.scenario.answer_timeout_s)
    finally:  # also after a second Ctrl-C: the thread must end before its arrays go
        flags[STOP] = 1
        while thread.is_alive() and not (external is not None and external.abandoned):
            with contextlib.suppress(KeyboardInterrupt):
                thread.join()
        for timeline in timelines:
            timeline.put_off = False
        for share in shares:
            getattr(share.link, "stop", _nothing)()
    if failed:
        raise failed[0]
    return found


def _nothing() -> None:
    """The start and the stop of a link that has neither method."""
