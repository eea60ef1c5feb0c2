"""A model in place of the kernel: the controller's ticks, with u from a program that is not ours.

The protocol of a tick, the references, the checks of y and u and the recording are the controller's
own. Only u comes from the model, by a call from Python.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import typeof, types
from numpy.typing import NDArray

from gfm_hil.core.errors import PeerLost
from gfm_hil.engine.controller_ticks import receive, reply
from gfm_hil.engine.loop_records import ControllerRecords, LinkEnd, Records, Why
from gfm_hil.models import Model
from gfm_runtime.compiled import compiled
from gfm_runtime.controller import accept, bad_output, follow_plant, measured
from gfm_runtime.signals import NY
from gfm_runtime.states import READY, RUNNING, SAFE

if TYPE_CHECKING:
    from gfm_hil.engine.timeline import Timeline

REFUSED, ACCEPTED, RESTARTED = range(3)
_LAW, _X = NY, NY + 2  # columns of the controller's recording that only a law fills


class SteppedModel:
    """A model that is stepped tick by tick, and watched.

    Args:
        model: not yet started.
        u: where its outputs begin, p.u.

    Raises:
        gfm_hil.models.ModelError: it refuses to start.
    """

    def __init__(self, model: Model, u: NDArray[np.float64]) -> None:
        self.name = model.name
        self.given_up = False
        self.last_words: Callable[[], None] = lambda: None
        self._model, self._u, self._start = model, u.copy(), u.copy()
        self._began, self._tick = 0, 0  # of the call in progress, ns; 0 if there is none
        self._calls: tuple[Any, ...] = ()
        model.start(self._start)

    def close(self) -> None:
        """End the model, if it still answers."""
        if not self.given_up:
            self._model.close()

    def __call__(
        self, end: LinkEnd, records: Records, controller: ControllerRecords, event: int
    ) -> Why:
        """As ``controller_ticks``.

        Raises:
            gfm_hil.models.ModelError: the model fails.
        """
        ctl, u, given = controller.ctl, self._u, (end, records, controller)
        if not self._calls:
            # numba finds out the types of such arguments anew at each call, which takes 400 µs
            kinds = tuple(map(typeof, given))
            self._calls = (
                receive_tick.compile((*kinds, types.int64)),
                send_tick.compile((*kinds, types.int64, typeof(u), types.boolean)),
            )
        receive_one, send_one = self._calls
        while True:
            why, took = receive_one(*given, event)
            if why != Why.GO_ON:
                return Why(why)
            self._tick = int(records.loop["tick"][0])
            self._began = time.monotonic_ns()
            if took == RESTARTED:
                if ctl["joins"][0]:
                    ctl["joins"] = 0
                    self._start[:] = 0.0
                    measured(records.y, self._start)
                self._model.start(self._start)
            if took != REFUSED:
                self._model.tick(ctl["ref"][0], records.y, u)
            self._began = 0
            if self.given_up:
                raise PeerLost(f"{self.name}: has answered too late")
            why = send_one(*given, event, u, took != REFUSED)
            row = records.rows[self._tick]
            row[_LAW] = row[_X:] = np.nan  # there is no law
            if why != Why.GO_ON:
                return Why(why)

    def watch(self, timeline: Timeline, patience_s: float) -> None:
        """End the run if the model has not answered for that long; another thread calls this.

        Raises:
            PeerLost: it has not.
        """
        began = self._began
        silent_s = (time.monotonic_ns() - began) * 1e-9 if began else 0.0
        if silent_s > patience_s:
            self.given_up = True
            problem = f"{self.name}: has not answered for {patience_s:g} s"
            timeline.end("safe", problem, self._tick)
            self.last_words()
            raise PeerLost(problem)


@compiled
def receive_tick(end, records, controller, event):
    """Wait for a tick and take its y: why to return, and whether u is to be computed."""
    ctl = controller.ctl
    why = receive(end, records, records.loop[0], ctl, event, 0)
    if why != Why.GO_ON:
        return why, REFUSED
    before = ctl[0].state
    follow_plant(ctl, end.reader[0].state == SAFE)
    if ctl[0].state != RUNNING or not accept(ctl[0], records.y):
        return why, REFUSED
    return why, RESTARTED if before == READY else ACCEPTED


@compiled
def send_tick(end, records, controller, event, found, computed):
    """Check ``found`` if it was ``computed``, make it u and send it; GO_ON, or why to return."""
    ctl, u = controller.ctl, records.u
    good = computed
    if computed:
        for i in range(len(u)):
            if found[i] - found[i] != 0.0 and good:
                bad_output(ctl, i)
                good = False
    if good:
        for i in range(len(u)):
            u[i] = found[i]
    return reply(end, records, records.loop[0], controller, event, ctl[0].changes)
