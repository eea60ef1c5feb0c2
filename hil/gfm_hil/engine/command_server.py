"""Takes an operator's commands for a running process on a socket of its own, off the loop.

A command is an event of a scenario without its time. A thread that the loop never waits for checks
it, puts a good one into the timeline and wakes the loop, which carries it out between two ticks.
The answer names that tick. ``by`` in the command says who gives
it (see ``Identity``), and the log of the run records that. The socket is a ZeroMQ REP on a Unix
path in a folder that only this user can read; ``commands_<role>.json`` in the run folder names it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zmq
from pydantic import TypeAdapter, ValidationError

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError, lines
from gfm_hil.core.identity import Identity
from gfm_hil.core.rate import Rate
from gfm_hil.core.roles import Role
from gfm_hil.engine.announcement import LARGEST, SCHEME, announcement_file
from gfm_hil.engine.setup import Bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.scenario.events import AnyEvent
from gfm_hil.scenario.events.base import Event

_LOOK_MS = 100
_TAKEN_OVER_S = 5.0  # in lockstep a tick lasts until the other side answers
_ROOM = 16  # commands that wait, of one operator
_PER_S, _BURST = 100.0, 200  # commands to one side, of all operators together

_EVENT: TypeAdapter[Any] = TypeAdapter(AnyEvent)
_UNKNOWN = {"through": "socket"}  # for a program that does not identify itself
_LOG = logging.getLogger(__name__)


class CommandServer:
    """One role's command server; use it as a context manager around the run.

    Args:
        role: of the run.
        places: the run folder, to announce the socket in, with its bench; of the plant of a
            network one for each converter.
        timelines: of each.
        wake: tells the loop that the timeline has something new.
        stop: ends the run as Ctrl-C would.
    """

    def __init__(
        self,
        role: Role,
        places: Sequence[tuple[Path, Bench]],
        timelines: Sequence[Timeline],
        wake: Callable[[], None],
        stop: Callable[[], None],
    ) -> None:
        self._role, self._places, self._timelines = role, places, timelines
        self._bench, self._timeline = places[0][1], timelines[0]
        self._wake, self._stop = wake, stop
        self._rate = Rate("all operators together", _PER_S, _BURST)
        self._over = threading.Event()

    def __enter__(self) -> CommandServer:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.set(zmq.MAXMSGSIZE, LARGEST)
        self._socket.set(zmq.RCVHWM, _ROOM)
        with contextlib.ExitStack() as stack:
            stack.callback(self._context.destroy, linger=0)
            place = stack.enter_context(scratch.temporary("gfmhil-commands-"))
            endpoint = f"{SCHEME}{place}/{self._role}"
            try:
                self._socket.bind(endpoint)
            except zmq.ZMQError as problem:
                raise UserError(
                    f"TMPDIR = {place.parent}: no socket can be made there: {problem}"
                ) from None
            self._resources = stack.pop_all()
        self._thread = threading.Thread(target=self._serve, name="commands", daemon=True)
        self._thread.start()
        self._endpoint = endpoint
        self._announce()
        return self

    def __exit__(self, *_: object) -> None:
        for folder, _bench in self._places:
            announcement_file(folder, self._role).unlink(missing_ok=True)
        self._over.set()
        self._thread.join()
        self._resources.close()

    def _announce(self) -> None:
        """Write down where the socket is, and to which laws the recording's law indices refer."""
        for folder, of in self._places:
            c = of.controller
            content = {"endpoint": self._endpoint, "T_s": c.T_s, "names": list(c.sets)}
            content["laws"] = [
                {"label": label, "name": name, "title": c.titles[name], "gains": gains}
                for label, name, gains in zip(c.labels, c.names, c.changed, strict=True)
            ]
            place = announcement_file(folder, self._role)
            new = place.with_suffix(".new")
            new.write_text(json.dumps(content), encoding="utf-8")
            new.replace(place)

    def _serve(self) -> None:
        while not self._over.is_set():
            if self._socket.poll(_LOOK_MS):
                with contextlib.suppress(zmq.ZMQError):  # the client has closed its connection
                    self._socket.send_json(self._answer(self._socket.recv()))

    def _answer(self, message: bytes) -> dict[str, Any]:
        try:
            content = json.loads(message)
            if not isinstance(content, dict):
                raise ValueError("a command must be an object")
            by = Identity.model_validate(content.pop("by", _UNKNOWN))
            if content == {"type": "stop"}:  # always passes
                for timeline in self._timelines:
                    timeline.stopped_by = by.plain()
                self._stop()
                return {"ok": True}
            self._rate.take()
            for key in ("t", "tick"):
                if key in content:
                    raise ValueError(f"{key} = {content[key]}: a command is carried out at once")
            return self._carry_out(self._checked({**content, "tick": 0}), by)
        except ValidationError as problem:
            return {"ok": False, "error": "; ".join(lines(problem, AnyEvent))}
        except (UserError, ValueError, RecursionError) as problem:
            return {"ok": False, "error": str(problem)}
        except Exception as problem:  # our own mistake must not end the server
            _LOG.exception("the %s's command server: %r", self._role, message[:200])
            return {"ok": False, "error": f"it cannot be carried out: {problem!r}"}

    def _checked(self, content: Any) -> Event:
        """The checked event; whatever could fail in the loop is tried here first. Raises
        ValueError: it is no event, belongs to the other role, or cannot be carried out."""
        event: Event = _EVENT.validate_python(content)
        if event.side != self._role:
            raise ValueError(f"type = {event.type!r}: for the {event.side}, not the {self._role}")
        event.check_now(self._bench)
        return event

    def _carry_out(self, event: Event, by: Identity) -> dict[str, Any]:
        ticket = self._timeline.insert(event, by.plain(), self._timelines[1:])
        self._wake()
        until = time.monotonic() + _TAKEN_OVER_S
        while not ticket.done.wait(_LOOK_MS * 1e-3):
            over = self._over.is_set()
            if (over or time.monotonic() >= until) and ticket.claim():
                late = f"not taken over within {_TAKEN_OVER_S:g} s"
                return {"ok": False, "error": "the run is over" if over else late}
        if ticket.error:
            return {"ok": False, "error": ticket.error}
        if event.changes_law:  # its new gains may have an index of their own
            self._announce()
        return {"ok": True, "tick": ticket.tick, "label": self._timeline.label(event)}
