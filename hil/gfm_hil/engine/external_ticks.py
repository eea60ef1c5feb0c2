"""The controller's ticks with u from an external program in place of the kernel.

The protocol of a tick, the references, the checks of y and u and the recording are the controller's
own. Only u comes from the external controller, by a call from Python. One that runs the run's own
laws also gets its changes of law.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import typeof, types
from numpy.typing import NDArray

from gfm_hil.controllers import ControllerError, ExternalController
from gfm_hil.controllers.external import State, put_back
from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.engine.controller_ticks import plant_tripped, receive, reply
from gfm_hil.engine.loop_records import ControllerRecords, LinkEnd, Records, ReturnReason
from gfm_hil.recording.columns import kept_of
from gfm_hil.recording.log import Status
from gfm_hil.scenario.events.base import Event
from gfm_hil.scenario.events.gains import GainChange, ready_gains
from gfm_runtime.assembly import Controller
from gfm_runtime.compiled import compiled, inlined
from gfm_runtime.controller import (
    accept,
    bad_output,
    follow_plant,
    measured,
    move_references,
    next_law,
    take_set_points,
)
from gfm_runtime.inner_tick import sense
from gfm_runtime.signals import NY, NY_INNER
from gfm_runtime.states import READY, RUNNING

if TYPE_CHECKING:
    from gfm_hil.controllers.external import PackedLaw

REFUSED, ACCEPTED, RESTARTED = range(3)
_COUNT = kept_of("controller").index("instructions")
_LAW, _X = NY, NY + 2  # columns of the controller's recording that only a law fills


class SteppedController:
    """An external controller that is stepped tick by tick, and watched.

    Args:
        external: not yet started.
        controller: at rest; its laws are those of an external one that runs ours.
        u: where the outputs begin, p.u.
        changed: the laws with other gains that the scenario's events ask for, as ``retuned``
            gives them.

    Raises:
        gfm_hil.controllers.ControllerError: it refuses to start.
        UserError: a program for the laws cannot be built, or does not start.
    """

    def __init__(
        self,
        external: ExternalController,
        controller: Controller,
        u: NDArray[np.float64],
        changed: Sequence[PackedLaw] = (),
    ) -> None:
        self.name, self.has_laws, self._external = external.name, external.has_laws, external
        self.abandoned = False
        self.last_words: Callable[[], None] = lambda: None
        self._u, self._start = u.copy(), u.copy()
        self._began, self._tick = 0, 0  # of the call in progress, ns; 0 if there is none
        self._calls: tuple[Any, ...] = ()
        external.begin(controller, changed)
        external.start(self._start)

    def state(self) -> State:
        """What it remembers between two ticks. Raises ControllerError: it refuses."""
        return {"name": np.array(self.name), "u": self._u.copy(), **self._external.state()}

    def restore(self, kept: State) -> None:
        """Go on from a snapshot. Raises UserError: that is of another controller; ControllerError:
        it refuses."""
        if (was := str(kept.get("name", "none"))) != self.name:
            raise UserError(f"its snapshot is of the controller {was}, not {self.name}")
        put_back(self.name, kept, "u", self._u)
        self._external.restore(kept)

    def check(self, event: Event, controller: Controller) -> None:
        """Refuse an event that the external controller cannot follow. Raises ValueError: why."""
        if not event.changes_law:
            return
        if not self.has_laws:
            raise ValueError(f"{self.name} has a law of its own")
        if isinstance(event, GainChange) and not self._external.has(
            ready_gains(controller, event.values)
        ):
            raise ValueError(
                f"{self.name} has only those gains in its code that the scenario names"
            )

    def close(self) -> None:
        """End the external controller: one that is not ours only if it still answers."""
        if self.has_laws or not self.abandoned:
            self._external.close()

    def _begin_anew(self, ctl: Any, y: NDArray[np.float64]) -> None:
        """Start after a reset: as at the beginning, or from what is measured in a network that went
        on. Raises gfm_hil.controllers.ControllerError: it refuses, or runs our laws, which its
        program starts from rest only."""
        if ctl["joins"][0]:
            ctl["joins"] = 0
            if self.has_laws:
                raise ControllerError(f"{self.name}: cannot join a network that goes on")
            self._start[:] = 0.0
            measured(y, self._start)
        self._external.start(self._start)

    def __call__(
        self, end: LinkEnd, records: Records, controller: ControllerRecords, event: int
    ) -> ReturnReason:
        """As ``controller_ticks``. Raises gfm_hil.controllers.ControllerError: the external
        controller fails."""
        ctl, u, given = controller.ctl, self._u, (end, records, controller)
        if not self._calls:
            # numba finds out the types of such arguments anew at each call, which takes 400 µs
            kinds = tuple(map(typeof, given))
            self._calls = (
                receive_tick.compile((*kinds, types.int64, types.boolean)),
                send_tick.compile((*kinds, types.int64, typeof(u), types.boolean, types.int64)),
            )
        receive_one, send_one = self._calls
        while True:
            why, took, changed = receive_one(*given, event, self.has_laws)
            if why != ReturnReason.GO_ON:
                return ReturnReason(why)
            self._tick = int(records.loop["tick"][0])
            self._began = time.monotonic_ns()
            if took == RESTARTED:
                self._begin_anew(ctl, records.y)
            if took != REFUSED:
                self._external.tick(ctl["ref"][0], records.y, u, changed)
                records.times[self._tick, _COUNT] = self._external.count
            self._began = 0
            if self.abandoned:
                raise PeerLost(f"{self.name}: has answered too late")
            why = send_one(*given, event, u, took != REFUSED, changed)
            if not self.has_laws:
                row = records.rows[self._tick]
                row[_LAW] = row[_X:] = np.nan
            if why != ReturnReason.GO_ON:
                return ReturnReason(why)

    def watch(self, end: Callable[[Status, str, int], None], patience_s: float) -> None:
        """End the run if the external controller has not answered for that long; another thread
        calls this. Raises PeerLost: it has not."""
        began = self._began
        silent_s = (time.monotonic_ns() - began) * 1e-9 if began else 0.0
        if silent_s > patience_s:
            self.abandoned = True
            problem = f"{self.name}: has not answered for {patience_s:g} s"
            end("safe", problem, self._tick)
            self.last_words()
            raise PeerLost(problem)


@compiled
def receive_tick(end, records, controller, event, has_laws):
    """Wait for a tick and take its y: why to return, whether u is to be computed, and the law to
    change to before, of an external controller that ``has_laws``; -1 for none."""
    ctl = controller.ctl
    why = receive(end, records, records.loop[0], ctl, event, 0)
    if why != ReturnReason.GO_ON:
        return why, REFUSED, -1
    before = ctl[0].state
    follow_plant(ctl, plant_tripped(end, records.loop[0]))
    take_set_points(ctl[0], records.y_sent, len(records.y))
    if ctl[0].state != RUNNING or not _takes(ctl[0], records.y, controller, has_laws):
        return why, REFUSED, -1
    changed = next_law(ctl[0], controller.est[0], ctl[0].y) if has_laws else -1
    return why, RESTARTED if before == READY else ACCEPTED, changed


@inlined
def _takes(c, y, controller, has_laws):
    """Whether y is to be given to the external controller. One that has a law of its own and takes
    counts judges itself."""
    if len(y) <= NY_INNER:
        return accept(c, y)
    if has_laws:
        return sense(c, controller.laws[c.active], controller.states[c.active], y)
    move_references(c)
    return True


@compiled
def send_tick(end, records, controller, event, found, computed, changed):
    """Check ``found`` if it was ``computed``, make it u and send it; GO_ON, or why to return.

    ``changed`` is the law to which this tick has changed, or -1.
    """
    ctl, u = controller.ctl, records.u
    changes = ctl[0].changes
    if changed >= 0:
        ctl[0].active, ctl[0].changes = changed, changes + 1
    good = computed
    if computed:
        for i in range(len(u)):
            if found[i] - found[i] != 0.0 and good:
                bad_output(ctl, i)
                good = False
    if good:
        for i in range(len(u)):
            u[i] = found[i]
    return reply(end, records, records.loop[0], controller, event, changes)
