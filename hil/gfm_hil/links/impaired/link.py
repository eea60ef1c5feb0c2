"""A link with an impairment stage at its receiving end, and the same interface."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types  # type: ignore[attr-defined]
from numba.extending import intrinsic

from gfm_hil.links.base import SIDES, Link, Side
from gfm_hil.links.impaired.settings import Impairment
from gfm_hil.links.impaired.stage import (
    COUNTED,
    INNER,
    INNER_WORDS,
    LONGEST,
    admit,
    make_stage,
    release,
)
from gfm_hil.links.port import Port, port_function


class ImpairedLink:
    """One end of any link, whose incoming messages pass a stage; implements ``Link``.

    Args:
        link: the end underneath, which this one closes too.
        settings: what happens to messages.
        side: whose end this is.
    """

    def __init__(self, link: Link, settings: Impairment, side: Side) -> None:
        self._link = link
        self._stage = make_stage(settings, SIDES.index(side))
        self._message = np.zeros(LONGEST, np.uint8)
        self.port = None if link.port is None else _port(link.port, self._stage)

    @property
    def injected(self) -> dict[str, int]:
        """How many messages were seen, and how many of them met which fate."""
        return {name: int(self._stage[index]) for name, index in COUNTED.items()}

    def send(self, message: bytes) -> bool:
        """As the link underneath."""
        return self._link.send(message)

    def receive(self) -> bytes | None:
        """The next message that the stage lets through."""
        while (message := self._link.receive()) is not None:
            if len(message) <= LONGEST:
                self._message[: len(message)] = np.frombuffer(message, np.uint8)
                admit(self._stage, self._message, len(message))
        size = release(self._stage, self._message)
        return self._message[:size].tobytes() if size else None

    def wait(self, seconds: float) -> bool:
        """Sleep until a message arrives underneath, shortly at most: one may be due by itself."""
        return self._link.wait(min(seconds, 0.001))

    def close(self) -> None:
        """As the link underneath."""
        self._link.close()


@intrinsic
def _pointer(typingctx: Any, address: Any) -> Any:
    """An int64 address as a pointer that ``carray`` takes."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), make


_as_pointer: Any = _pointer


def _port(inner: Port, stage: np.ndarray) -> Port:
    """The port of an impaired link: closures over the functions of the one underneath.

    Compiled anew in every process, since they hold addresses; it takes a second.
    """
    stage[INNER], stage[INNER_WORDS] = inner.handle.ctypes.data, len(inner.handle)
    inner_send, inner_receive = inner.send, inner.receive

    def send(handle, message):
        under = carray(_as_pointer(handle[INNER]), handle[INNER_WORDS], np.int64)
        return inner_send(under, message)

    def receive(handle, message):
        under = carray(_as_pointer(handle[INNER]), handle[INNER_WORDS], np.int64)
        size = inner_receive(under, message)
        while size > 0:
            if size <= len(message):
                admit(handle, message, size)
            size = inner_receive(under, message)
        return release(handle, message)

    return Port(stage, port_function(send, cached=False), port_function(receive, cached=False),
                inner.spins)  # fmt: skip
