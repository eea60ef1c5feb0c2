"""An operator: sends commands to a run by its folder, and reads what it records as it goes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

import zmq

from gfm_hil.errors import UserError
from gfm_hil.events import CONTROLLER_EVENTS
from gfm_hil.links.base import Side
from gfm_hil.operator.announced import LARGEST, announced, present
from gfm_hil.recording import CONTROLLER_COLUMNS, PLANT_COLUMNS, Part
from gfm_plant import TRIP_REASONS
from gfm_runtime.controller import REASONS, STATES

_ANSWER_MS = 6000
_CONTROLLERS = {get_args(e.model_fields["type"].annotation)[0] for e in CONTROLLER_EVENTS}


class Operator:
    """Commands and a look, for one run that is going on.

    Args:
        folder: the run folder.

    Raises:
        UserError: nothing is going on there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = zmq.Context()
        if not present(folder):
            raise UserError(f"{folder}: no run is going on there")

    def close(self) -> None:
        """Let go of the sockets."""
        self._context.destroy(linger=0)

    def tell(self, event: dict[str, Any]) -> dict[str, Any]:
        """Have an event of a scenario, without its time, carried out at once.

        Returns:
            ``tick`` at which it was, and its ``label``.

        Raises:
            UserError: it was refused, with the reason; or the side is gone.
        """
        side: Side = "controller" if event.get("type") in _CONTROLLERS else "plant"
        return self._ask(side, event)

    def stop(self) -> None:
        """End the run as Ctrl-C would."""
        for side in present(self._folder):
            self._ask(side, {"type": "stop"})
            return

    def snapshot(self) -> dict[str, Any]:
        """The newest recorded tick: every column of the recording by name, and in words.

        Of the plant: ``tick``, ``misses``, ``trip`` ("" without one). Of the controller:
        ``state``, ``reason`` (why SAFE), ``active`` (name of the law in force), ``gains`` (what of
        it is not as in its file), ``laws`` (names of those that are ready), ``T_s`` (s). A side
        that has not recorded anything is left out.

        Rows are only ever appended, so that reading them takes nothing from the loop.
        """
        found: dict[str, Any] = {}
        sides: tuple[tuple[Side, tuple[str, ...]], ...]
        sides = ("plant", PLANT_COLUMNS), ("controller", CONTROLLER_COLUMNS)
        for side, columns in sides:
            part = Part.open(self._folder, side)
            done = 0 if part is None else int(part.progress[0])
            if part is None or not done:
                continue
            found.update(zip(columns, part.signals[done - 1].tolist(), strict=True))
            if side == "plant":
                found["tick"], found["misses"] = done - 1, int(part.progress[1])
                trip = int(found["true_trip"])
                found["trip"] = TRIP_REASONS[trip] if trip else ""
            else:
                found["state"] = STATES[int(found["state"])]
                found["reason"] = REASONS[int(part.progress[1])]
                if (desk := announced(self._folder, side)) is not None:
                    law = desk["laws"][int(found["law"])]
                    found["active"], found["gains"] = law["name"], law["gains"]
                    found["laws"], found["T_s"] = desk["names"], desk["T_s"]
        return found

    def _ask(self, side: Side, content: dict[str, Any]) -> dict[str, Any]:
        desk = announced(self._folder, side)
        if desk is None:
            raise UserError(f"{self._folder}: the {side} is not running")
        with self._context.socket(zmq.REQ) as socket:
            socket.set(zmq.LINGER, 0)
            socket.set(zmq.MAXMSGSIZE, LARGEST)
            socket.connect(desk["endpoint"])
            socket.send_json(content)
            if not socket.poll(_ANSWER_MS):
                raise UserError(f"{self._folder}: the {side} does not answer")
            answer: Any = socket.recv_json()
        if not answer["ok"]:
            raise UserError(str(answer["error"]))
        return {key: value for key, value in answer.items() if key != "ok"}
