"""The ends of the C ping-pongs: Python opens and closes what the C loops use."""

from __future__ import annotations

import ctypes
import socket
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.benchmark.c_code import load_c
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role

_SLOTS = 2 * 1024  # bytes, two slot_t
_WORD = ctypes.c_int64
_ORDER: dict[Role, int] = {"controller": 1, "plant": -1}


class CEnd:
    """One end of a C ping-pong.

    Args:
        library: pingpong.c, compiled.
        kind: ``shm``, ``udp`` or ``zmq``.
        arguments: first arguments of the kind's functions, as ctypes values.
        size: bytes that this side sends.
        keep: resources to free at the end.
    """

    compiled = True

    def __init__(
        self, library: Path, kind: str, arguments: list[Any], size: int, keep: ExitStack
    ) -> None:
        functions = load_c(library)
        self._ping, self._pong = functions[f"ping_{kind}"], functions[f"pong_{kind}"]
        self._ping.restype, self._pong.restype = _WORD, None
        self._arguments, self._size, self._keep = arguments, _WORD(size), keep

    def ping(
        self, stop: NDArray[np.int64], period_ns: int, duration_ns: int, took: NDArray[np.int64]
    ) -> int:
        """Send requests; see ``gfm_hil.benchmark.pingpong``."""
        return int(
            self._ping(
                *self._arguments, self._size, _WORD(period_ns), _WORD(duration_ns),
                ctypes.c_void_p(took.ctypes.data), _WORD(len(took)),
            )
        )  # fmt: skip

    def pong(self, stop: NDArray[np.int64]) -> None:
        """Answer until stopped."""
        self._pong(*self._arguments, self._size, ctypes.c_void_p(stop.ctypes.data))

    def close(self) -> None:
        """Free sockets and memory."""
        self._keep.close()


def open_shm(library: Path, role: Role, path: str, size: int) -> CEnd:
    """Shared memory: a file that both sides map."""
    if role == "controller":
        Path(path).write_bytes(bytes(_SLOTS))
    slots = np.memmap(path, np.uint8, "r+")
    keep = ExitStack()
    keep.callback(slots.flush)  # keeps the mapping alive with the end
    first = _WORD(role == "controller")
    return CEnd(library, "shm", [ctypes.c_void_p(slots.ctypes.data), first], size, keep)


def open_udp(library: Path, role: Role, ports: str, size: int) -> CEnd:
    """UDP on the loopback interface; ``ports`` are those of the controller and the plant."""
    keep = ExitStack()
    end = keep.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    own, other = (("127.0.0.1", int(port)) for port in ports.split(",")[:: _ORDER[role]])
    end.bind(own)
    end.connect(other)
    return CEnd(library, "udp", [_WORD(end.fileno())], size, keep)


def open_zmq(library: Path, role: Role, endpoint: str, size: int) -> CEnd:
    """libzmq, the same library as the link's, on a socket with the link's options.

    Raises:
        UserError: its functions cannot be found.
    """
    import zmq
    from zmq.backend.cython import _zmq

    from gfm_hil.links.zeromq.link import pair_socket

    keep = ExitStack()
    context = keep.enter_context(zmq.Context())
    end = keep.enter_context(pair_socket(context))
    end.set(zmq.LINGER, 0)
    if role == "controller":
        end.bind(endpoint)
    else:
        end.connect(endpoint)
    libzmq = ctypes.CDLL(_zmq.__file__)  # resolves the library that it is linked to
    try:
        call = [ctypes.cast(libzmq[name], ctypes.c_void_p) for name in ("zmq_send", "zmq_recv")]
    except AttributeError:
        keep.close()
        raise UserError("pyzmq hides its libzmq: nothing for C to call") from None
    return CEnd(library, "zmq", [ctypes.c_void_p(end.underlying), *call], size, keep)
