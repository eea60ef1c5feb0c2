"""An operator: finds a run by its folder, sends commands to it and reads its growing recording."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zmq

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity, local
from gfm_hil.core.roles import Role
from gfm_hil.engine.announcement import (
    LARGEST,
    members,
    not_running,
    read_announcement,
    running_roles,
)
from gfm_hil.recording.live import LiveRun
from gfm_hil.scenario.events import EVENTS
from gfm_plant import TRIP_REASONS
from gfm_runtime.states import REASONS, STATES

_ANSWER_MS = 6000


class Operator:
    """Sends commands to one run in progress and reads its state. Raises UserError: no run is in
    progress there.

    Args:
        folder: the run folder; that of a network reaches what its converters share: its grid,
            lines, loads and breakers, the notes and the stop.
        through: what passes the commands on, for the log of the run.

    Attributes:
        run: all that it has recorded; of a network's folder the converter by which the plant is
            reached.
    """

    def __init__(self, folder: Path, through: str = "python") -> None:
        places = (place for place in (folder, *members(folder)) if running_roles(place))
        if (reached := next(places, None)) is None:
            raise not_running(folder)
        self._folder, self._local = reached, local(through)
        self._network = folder if reached != folder else None
        self._context, self.run = zmq.Context(), LiveRun(reached)

    def close(self) -> None:
        """Close the sockets."""
        self._context.destroy(linger=0)

    def command(self, event: dict[str, Any], by: Identity | None = None) -> dict[str, Any]:
        """Have the run carry out a scenario event, given without its time, at once. Raises
        UserError: the run refused it, with the reason; or the side is gone.

        Args:
            event: plain data, ``type`` and its fields.
            by: who gives the command; this process if None.

        Returns:
            ``tick`` at which it was carried out, and its ``label``.
        """
        kind = event.get("type", "")
        if not isinstance(kind, str):
            raise UserError(f"type = {str(kind)[:60]}: must be the name of an event")
        side = EVENTS[kind].side if kind in EVENTS else "plant"
        if self._network is not None and side == "controller":
            raise not_running(self._network)
        return self._ask(side, event, by)

    def tell(self, event: dict[str, Any], by: Identity | None = None) -> dict[str, Any]:
        """The former name of ``command``, for one version."""
        warnings.warn("Operator.tell is now Operator.command", DeprecationWarning, stacklevel=2)
        return self.command(event, by)

    def stop(self, by: Identity | None = None) -> None:
        """Stop the run as Ctrl-C does; with a converter of a network, all of it. Raises UserError:
        the run does not answer."""
        running = running_roles(self._folder)
        if running:
            self._ask("plant" if "plant" in running else running[0], {"type": "stop"}, by)

    def snapshot(self) -> dict[str, Any]:
        """The newest recorded tick: every column of the recording by name, codes also as words.

        Of the plant: ``tick``, ``misses``, ``trip`` ("" without one). Of the controller:
        ``state``, ``reason`` (why SAFE), ``active`` (what the law in force is asked for by),
        ``law_title`` (its name in results), ``gains`` (those that differ from its file), ``laws``
        (what those that are ready are asked for by), ``T_s`` (s). A side that has not recorded
        anything is left out.

        The loop only appends rows, so that reading them does not disturb it. Raises UserError: the
        recording is damaged; the folder is of a network.
        """
        if self._network is not None:
            raise not_running(self._network)
        found: dict[str, Any] = {}
        run = self.run
        if done := run.done("plant"):
            found |= {**run.row("plant", done - 1), "tick": done - 1, "misses": run.misses}
            found["trip"] = self._word("trip", {**TRIP_REASONS, 0: ""}, found["true_trip"])
        if done := run.done("controller"):
            found |= run.row("controller", done - 1)
            found["state"] = self._word("state", dict(enumerate(STATES)), found["state"])
            found["reason"] = self._word("reason", dict(enumerate(REASONS)), run.safe_reason)
            if (server := read_announcement(self._folder, "controller")) is not None:
                law = self._word("law", dict(enumerate(server["laws"])), found["law"])
                found["active"], found["gains"] = law["name"], law["gains"]
                found["law_title"] = law["title"]
                found["laws"], found["T_s"] = server["names"], server["T_s"]
        return found

    def _word(self, what: str, words: Mapping[int, Any], code: float) -> Any:
        """The meaning of a recorded code; raises UserError for one without."""
        if code not in words:
            raise UserError(f"{self._folder}: damaged: there is no {what} of number {code:g}")
        return words[int(code)]

    def _ask(self, role: Role, event: dict[str, Any], by: Identity | None) -> dict[str, Any]:
        server = read_announcement(self._folder, role)
        if server is None:
            raise UserError(f"{self._folder}: the {role} is not running")
        try:
            with self._context.socket(zmq.REQ) as socket:
                socket.set(zmq.LINGER, 0)
                socket.set(zmq.MAXMSGSIZE, LARGEST)
                socket.connect(server["endpoint"])
                socket.send_json({**event, "by": (by or self._local).plain()})
                if not socket.poll(_ANSWER_MS):
                    raise UserError(f"{self._folder}: the {role} does not answer")
                answer: Any = socket.recv_json()
        except zmq.ZMQError as problem:  # for example no descriptor for a socket
            raise UserError(f"{self._folder}: the {role} cannot be asked: {problem}") from None
        if not answer.pop("ok"):
            raise UserError(str(answer["error"]))
        return dict(answer)
