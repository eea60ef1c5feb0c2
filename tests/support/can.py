"""The parts of a CAN node separately, with messages as bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gfm_hil.core.roles import Role
from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.segments import LONGEST, join, joiner_dtype, set_joiner
from gfm_hil.links.can.subrate import admit, goes, in_force, made, set_subrate, subrate_dtype
from gfm_hil.links.can.vectors import NOTHING, decode, knows, receiver_dtype, set_receiver
from gfm_hil.links.can.wire import frame_dtype
from gfm_runtime.signals import Vector


def frame_of(number: int, payload: bytes) -> np.ndarray:
    """A CAN frame in the node's format, in an array."""
    frame = np.zeros(1, frame_dtype)
    frame["id"], frame["length"] = number, len(payload)
    frame["data"][0, : len(payload)] = np.frombuffer(payload, np.uint8)
    return frame


class VectorReceiver:
    """Converts CAN frames back to frames of the bench."""

    def __init__(self, plan: Plan, group: Vector) -> None:
        self._record, self._message = np.zeros(1, receiver_dtype), np.zeros(LONGEST, np.uint8)
        set_receiver(self._record, plan, group)

    @property
    def incomplete(self) -> int:
        return int(self._record["incomplete"][0])

    def knows(self, number: int) -> bool:
        return bool(knows(self._record, number))

    def take(self, number: int, payload: bytes) -> bytes | None:
        size = decode(self._record, frame_of(number, payload)[0], self._message)
        return None if size == NOTHING else self._message[:size].tobytes()


class Joiner:
    """Joins the other side's segments; returns a message or a code."""

    def __init__(self, plan: Plan, role: Role) -> None:
        self._record, self._message = np.zeros(1, joiner_dtype), np.zeros(LONGEST, np.uint8)
        set_joiner(self._record, plan, role)

    damaged = property(lambda self: int(self._record["damaged"][0]))
    theirs = property(lambda self: int(self._record["theirs"][0]))
    digest = property(lambda self: int(self._record["digest"][0]))

    def take(self, payload: bytes) -> bytes | int | None:
        size = join(self._record, frame_of(0, payload)[0], self._message)
        if size == NOTHING:
            return None
        return self._message[:size].tobytes() if size >= 0 else size


class Subrate:
    """One side's stage, fed by ``receive``."""

    def __init__(self, role: Role, every: int, receive: Callable[[], bytes | None]) -> None:
        self._record, self._message = np.zeros(1, subrate_dtype), np.zeros(100, np.uint8)
        self._receive = receive
        set_subrate(self._record, role, every)

    def goes(self, message: bytes) -> bool:
        return bool(goes(self._record, np.frombuffer(message, np.uint8)))

    def receive(self) -> bytes | None:
        """As in ``node.receive``."""
        size = made(self._record, self._message)
        while size == NOTHING:
            message = self._receive()
            if message is None:
                size = in_force(self._record, self._message)
                return None if size == NOTHING else self._message[:size].tobytes()
            self._message[: len(message)] = np.frombuffer(message, np.uint8)
            size = admit(self._record, self._message, len(message))
        return self._message[:size].tobytes()
