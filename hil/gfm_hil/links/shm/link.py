"""Shared-memory link: a ring each way; the controller creates the memory, the plant joins it."""

import time

import numpy as np

from gfm_hil.core.roles import Role
from gfm_hil.links import ring
from gfm_hil.links.base import LONGEST, unusable, wait_until
from gfm_hil.links.port import Port
from gfm_hil.links.shm import segment

_SPINS = 200  # polls, about 10 µs; then yield, since the peer may need the same processor
_FIRST_S, _LONGEST_S = 50e-6, 1e-3  # first and longest sleep of a wait


class ShmLink:
    """One end of the link; implements ``gfm_hil.links.Link``. Raises UserError: the memory is in
    use, or another user made it. If the controller starts later, the plant's ``send``, ``receive``
    and ``wait`` may raise it too.

    Args:
        role: the controller creates the memory, the plant joins it; either may start first.
        endpoint: ``shm://name``.
    """

    port: Port

    def __init__(self, role: Role, endpoint: str) -> None:
        self._role, self._endpoint = role, endpoint
        self._segment: segment.Segment | None = None
        self._handle = ring.make_handle()
        self._message = np.empty(LONGEST, np.uint8)
        self._closed = False
        ring.warm_up()
        patient = ring.port_patient if ring.HAS_BELLS else None
        self.port = Port(self._handle, ring.port_send, ring.port_receive, _SPINS, patient)
        self._open()

    def send(self, message: bytes) -> bool:
        if len(message) > LONGEST or not self._there():
            return False
        room = self._message[: len(message)]
        room[:] = np.frombuffer(message, np.uint8)
        return bool(ring.put(self._handle, room))

    def receive(self) -> bytes | None:
        size = self._there() and ring.take(self._handle, self._message)
        return self._message[:size].tobytes() if size else None

    def wait(self, seconds: float) -> bool:
        def has_message() -> bool:
            return self._there() and bool(ring.waiting(self._handle))

        return wait_until(has_message, time.monotonic() + seconds, _FIRST_S, _LONGEST_S)

    def close(self) -> None:
        """Release the memory; a peer that has joined can still read the last messages."""
        self._closed = True
        self._handle[:] = 0
        mine, self._segment = self._segment, None
        if mine is not None:
            (segment.remove if self._role == "controller" else segment.leave)(mine)

    def connected(self) -> bool:
        if self._role == "controller":
            return self._segment is not None and segment.has_plant(self._segment)
        return self._there()

    def _there(self) -> bool:
        if self._segment is None and not self._closed:
            self._open()
        return self._segment is not None

    def _open(self) -> None:
        name = self._endpoint.removeprefix("shm://")
        owner = self._role == "controller"
        try:
            found = segment.create(name) if owner else segment.join(name)
        except segment.Refused as problem:
            verb = "created" if owner else "joined"
            raise unusable(self._endpoint, verb, problem) from None
        if found is None:
            return
        words = np.frombuffer(found.memory, np.int64)
        out, into = (1, 0) if owner else (0, 1)
        h = self._handle
        h[ring.SEEN] = words[segment.HEADS[out] // ring.WORD]
        h[ring.TAKEN] = words[segment.HEADS[into] // ring.WORD]
        first = segment.RINGS[out] // ring.WORD
        stamps = words[first : first + ring.RING // ring.WORD : ring.SLOT // ring.WORD]
        h[ring.SENT] = stamps.max() >> ring.LENGTH_BITS
        base = words.ctypes.data
        h[ring.OUT_HEAD], h[ring.IN_HEAD] = base + np.array(segment.HEADS)[[out, into]]
        if ring.HAS_BELLS:
            h[ring.OUT_BELL], h[ring.IN_BELL] = base + np.array(segment.BELLS)[[out, into]]
        h[ring.OUT], h[ring.IN] = base + np.array(segment.RINGS)[[out, into]]
        self._segment = found
