"""The parts of a CAN node separately, with messages as bytes."""

import numpy as np

from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.vectors import NOTHING, decode, part_of, receiver_dtype, set_receiver
from gfm_hil.links.can.wire import MOST, frame_dtype
from gfm_runtime.signals import VectorName


def frame_of(number: int, payload: bytes) -> np.ndarray:
    """A CAN frame in the node's format, in an array."""
    frame = np.zeros(1, frame_dtype)
    frame["id"], frame["length"] = number, len(payload)
    frame["data"][0, : len(payload)] = np.frombuffer(payload, np.uint8)
    return frame


class VectorReceiver:
    """Converts CAN frames back to frames of the bench."""

    def __init__(self, plan: Plan, group: VectorName) -> None:
        self._record, self._message = np.zeros(1, receiver_dtype), np.zeros(MOST, np.uint8)
        set_receiver(self._record, plan, group)

    @property
    def incomplete(self) -> int:
        return int(self._record["incomplete"][0])

    def belongs(self, number: int) -> bool:
        return bool(part_of(self._record, number) != NOTHING)

    def take(self, number: int, payload: bytes) -> bytes | None:
        part = part_of(self._record, number)
        size = decode(self._record, part, frame_of(number, payload)[0], self._message)
        return None if size == NOTHING else self._message[:size].tobytes()
