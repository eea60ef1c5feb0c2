"""The contenders of the benchmark: the bench's links, and for each the limit in C.

A contender is plain data that is sent to the two processes; each opens its end.
"""

from __future__ import annotations

import ctypes
import secrets
import socket
import tempfile
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.c_code import load_c
from gfm_hil.bench.peers import Iceoryx2Link, has_iceoryx2
from gfm_hil.bench.pingpong import LONGEST, LinkEnd, Messages, frames, plain
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import link_kind, open_link
from gfm_hil.links.frame import wire_dtype
from gfm_runtime.signals import NY

_SLOTS = 2 * 1024  # bytes, two slot_t
_WORD = ctypes.c_int64
_ORDER: dict[Role, int] = {"controller": 1, "plant": -1}

FRAME = wire_dtype(NY).itemsize  # bytes of y; the answer is a u


@dataclass(frozen=True)
class Contender:
    """One way to send a message there and back.

    Attributes:
        name: in tables, unique.
        link: name of the link, or of the C peer's transport (``shm``, ``udp``, ``zmq``).
        peer: ``ours``, ``C`` or the name of a foreign package.
        endpoint: of both sides.
        options: of the link.
        baseline: name of the contender that it is compared with; its own name for a limit.
        library: compiled library of a C peer.
    """

    name: str
    link: str
    peer: str
    endpoint: str
    options: dict[str, Any]
    baseline: str
    library: Path | None = None

    def open(self, role: Role, payload: int) -> LinkEnd | CEnd:
        """Open one end; the controller first.

        Raises:
            UserError: as ``open_link``.
        """
        messages = self.messages(role, payload)
        if self.peer == "C":
            assert self.library is not None
            how = {"shm": open_shm, "udp": open_udp, "zmq": open_zmq}
            return how[self.link](self.library, role, self.endpoint, messages.shape[1])
        if self.peer == "iceoryx2":
            return LinkEnd(Iceoryx2Link(role, self.endpoint, LONGEST), messages)
        return LinkEnd(open_link(self.link, role, self.endpoint, self.options), messages)

    @staticmethod
    def messages(role: Role, payload: int) -> Messages:
        """The messages of a side: the bench's frames if the payload has their size."""
        if payload == FRAME:
            return frames("y" if role == "plant" else "u")
        return plain(payload)


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
        """Send requests; see ``gfm_hil.bench.pingpong``."""
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


def check_links(names: list[str]) -> list[str]:
    """The names, if each is a link.

    Raises:
        UserError: one is not, or cannot be loaded.
    """
    for name in names:
        try:
            link_kind(name)
        except ValueError as problem:
            raise UserError(f"--links: {problem}") from None
    return names


def of_links(links: list[str], place: Path, library: Path | None) -> list[Contender]:
    """The contenders of some links and the limits that they are compared with.

    Args:
        links: names, checked.
        place: an empty folder in memory with a short path.
        library: pingpong.c, or None if there is no compiler.
    """
    found: dict[str, Contender] = {}

    def limit(name: str, link: str, endpoint: str) -> str:
        if library is None:
            return ""
        found.setdefault(name, Contender(name, link, "C", endpoint, {}, name, library))
        return name

    def ours(name: str, link: str, endpoint: str, baseline: str, **options: Any) -> None:
        found[name] = Contender(name, link, "ours", endpoint, options, baseline)

    for link in links:
        kind = link_kind(link)
        folder = place / link
        folder.mkdir()
        if link == "zmq":
            ipc, tcp = kind.fresh(folder), f"tcp://127.0.0.1:{free_port()}"
            limit_ipc = limit("C zmq ipc", "zmq", f"ipc://{folder}/c")
            ours("zmq ipc", link, ipc, limit_ipc)
            ours("zmq ipc, portable", link, f"{ipc}-portable", limit_ipc, portable=True)
            limit_tcp = limit("C zmq tcp", "zmq", f"tcp://127.0.0.1:{free_port()}")
            ours("zmq tcp", link, tcp, limit_tcp)
        elif link == "shm":
            in_c = limit("C shm", "shm", str(place / "slots"))
            ours(link, link, kind.fresh(folder), in_c)
            if has_iceoryx2():
                name = f"gfmhil-{secrets.token_hex(8)}"
                found["iceoryx2"] = Contender("iceoryx2", "iceoryx2", "iceoryx2", name, {}, in_c)
        else:
            in_c = limit("C udp", "udp", f"{free_port()},{free_port()}")
            ours(link, link, kind.fresh(folder), in_c)
    return list(found.values())


def free_port() -> int:
    """A port of the loopback interface that is free for TCP, and most likely for UDP."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def memory_folder(stack: ExitStack) -> Path:
    """A folder that is removed at the end; in memory if /dev/shm exists."""
    memory = Path("/dev/shm")
    place = str(memory) if memory.is_dir() else None
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="gfmhil-", dir=place)))
