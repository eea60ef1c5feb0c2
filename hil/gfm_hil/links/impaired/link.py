"""A link with an impairment stage at its receiving end, and the same interface."""

from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types  # type: ignore[attr-defined]

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.links.base import LONGEST, Link
from gfm_hil.links.impaired import Impairment
from gfm_hil.links.impaired.stage import (
    COUNTED,
    INNER,
    INNER_WORDS,
    REFUSED,
    admit,
    make_stage,
    release,
    waiting,
)
from gfm_hil.links.port import Port, port_function
from gfm_hil.links.pump import with_port
from gfm_runtime.compiled import intrinsic


class ImpairedLink:
    """One end of any link, whose incoming messages pass a stage; implements ``Link``.

    Args:
        link: the wrapped end, which this one closes too.
        settings: the faults to inject.
        role: whose end this is.
    """

    def __init__(self, link: Link, settings: Impairment, role: Role) -> None:
        self._link = with_port(link)
        self._stage = make_stage(settings, ROLES.index(role))
        self._message = np.zeros(LONGEST, np.uint8)
        assert self._link.port is not None
        self.port = _port(self._link.port, self._stage)

    @property
    def injected(self) -> dict[str, int]:
        """How many messages the stage has seen, how many got each fault, how many still wait."""
        counts = {name: int(self._stage[index]) for name, index in COUNTED.items()}
        return {**counts, "waiting": int(waiting(self._stage))}

    def send(self, message: bytes) -> bool:
        sent = self._link.send(message)
        self._stage[REFUSED] += not sent
        return sent

    def receive(self) -> bytes | None:
        """The next message that the stage releases; later messages stay on the link."""
        while not (size := release(self._stage, self._message)):
            if (message := self._link.receive()) is None:
                return None
            if len(message) <= LONGEST:
                self._message[: len(message)] = np.frombuffer(message, np.uint8)
                admit(self._stage, self._message, len(message))
        return self._message[:size].tobytes()

    def wait(self, seconds: float) -> bool:
        """Sleep until the wrapped link has a message, at most 1 ms: a delayed one may be due."""
        return self._link.wait(min(seconds, 0.001))

    def close(self) -> None:
        self._link.close()

    def __getattr__(self, name: str) -> Any:
        """Other methods of the wrapped link, see ``Link``."""
        return getattr(self._link, name)


def warm_up() -> None:
    """Compile (or load from the cache) the stage; the functions around it are compiled anew in
    every process."""
    stage, message = make_stage(Impairment(delay=1e-6), 0), np.zeros(LONGEST, np.uint8)
    admit(stage, message, 1)
    release(stage, message)
    waiting(stage)


@intrinsic
def _pointer(typingctx, address):
    """Convert an int64 address to a pointer for ``carray``."""

    def make(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.int64), make


def _port(inner: Port, stage: np.ndarray) -> Port:
    """The port of an impaired link: its handle is the stage, which points to the inner handle."""
    stage[INNER], stage[INNER_WORDS] = inner.handle.ctypes.data, len(inner.handle)
    calls = _functions(inner.send, inner.receive)
    return Port(stage, *calls, inner.spins, None, inner.spin_limit, inner.paced)


@cache
def _functions(inner_send: Any, inner_receive: Any) -> tuple[Any, Any]:
    """Send and receive of an impaired port: closures over those of the wrapped link's port.

    Every process compiles them anew, since they hold addresses; it takes a second.
    """

    def send(handle, message):
        under = carray(_pointer(handle[INNER]), handle[INNER_WORDS], np.int64)
        sent = inner_send(under, message)
        handle[REFUSED] += sent == 0
        return sent

    def receive(handle, message):
        under = carray(_pointer(handle[INNER]), handle[INNER_WORDS], np.int64)
        size = release(handle, message)
        while size == 0:
            came = inner_receive(under, message)
            if came <= 0:
                return came
            if came <= len(message):
                admit(handle, message, came)
            size = release(handle, message)
        return size

    return port_function(send, cached=False), port_function(receive, cached=False)
