"""Contenders of ``gfmhil bench latency``: links of the bench, their limits in C, other packages.

A contender of another package is one file of this folder and its name in ``PEERS``. It has a
function ``contenders(folder)``, which yields what it adds; folder is a ``memory_folder``. All are
plain data that goes to the two processes, each of which opens its end.
"""

from __future__ import annotations

import socket
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar

from gfm_hil.bench.c_code import NoCompiler, compile_c
from gfm_hil.bench.pingpong import Messages, PingPong, frames, over_link, plain
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import Link, link_kind, open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import wire_dtype
from gfm_runtime.children import GRACE_S
from gfm_runtime.signals import NY

FRAME = wire_dtype(NY).itemsize  # bytes of the frame with y; the reply is the one with u
ELSEWHERE = "to"  # in place of the ``peer`` of who answers elsewhere
#: files of other packages' transports, in the order of the tables, and the packages that each needs
PEERS = {
    "cyclonedds": ("cyclonedds",),
    "grpc": ("grpc",),
    "iceoryx2": ("iceoryx2", "flatbuffers"),
    "lcm": ("lcm",),
    "modbus": ("pymodbus",),
    "nng": ("pynng",),
    "zenoh": ("zenoh",),
}


@dataclass(frozen=True)
class Contender:
    """One way to send a message there and back."""

    name: str  # in tables, unique
    link: str  # name of the link, or of the transport of C or of another package
    endpoint: str  # where both sides meet
    # opens one end that sends these messages; a function or class of a module. What it returns is
    # called as a link is, if it is no ``PingPong``. The controller opens its end first
    end: Callable[[Contender, Role, Messages], Any]
    peer: str = "ours"  # ``ours``, ``C``, ``ELSEWHERE`` or the name of another package
    options: dict[str, Any] = field(default_factory=dict)  # of the link
    # name of the contender in C that it is compared with; its own name for one in C
    limit: str = ""
    longest: int = 65507  # bytes of a message
    source: Path | None = None  # C source of a limit
    library: Path | None = None  # ``source``, compiled

    def open(self, role: Role, payload: int) -> PingPong:
        """Open one end, for requests of ``payload`` bytes. Raises UserError: it cannot be opened
        here, or does not carry so many bytes."""
        if payload > self.longest:
            raise UserError(f"it carries messages of up to {self.longest} bytes")
        own = messages(role, payload)
        end = self.end(self, role, own)
        return end if isinstance(end, PingPong) else over_link(end, own)


def missing_packages(peer: str) -> list[str]:
    """The packages that a peer needs and that are not installed."""
    return [package for package in PEERS[peer] if find_spec(package) is None]


def contenders_of(
    names: Sequence[str], folder: Path, more: Sequence[Contender] = ()
) -> tuple[list[Contender], list[str]]:
    """The contenders of links and peers, ``more`` of them, and their limits; and remarks: without a
    C compiler there are no limits. ``folder`` is an empty ``memory_folder``."""
    from gfm_hil.bench.contenders import ours

    each = [*ours.contenders(names, folder)]
    for peer in PEERS:
        if peer in names:
            each += import_module(f"{__name__}.{peer}").contenders(folder)
    each += more
    limits = {one.limit for one in each if one.source is None}
    every = [one for one in each if one.source is None or one.name in limits]
    try:
        libraries = {
            source: compile_c(source, folder, f"{source.stem}_pingpong")
            for source in dict.fromkeys(c.source for c in every if c.source is not None)
        }
    except NoCompiler as problem:
        without = [replace(c, limit="") for c in every if c.source is None]
        return without, [f"{problem}: no limits in C, no ratios"]
    return [replace(c, library=libraries[c.source]) if c.source else c for c in every], []


def messages(role: Role, payload: int) -> Messages:
    """The messages of a side: the bench's frames if the payload has their size."""
    if payload == FRAME:
        return frames("y" if role == "plant" else "u")
    return plain(payload)


def of_link(name: str, link: str, endpoint: str, limit: str, **options: Any) -> Contender:
    """A link of the bench with these options."""
    return Contender(
        name, link, endpoint, _open_link, options=options, limit=limit, longest=LONGEST
    )


def _open_link(c: Contender, role: Role, own: Messages) -> Link:
    return open_link(c.link, role, c.endpoint, c.options)


class PackageEnd:
    """Base of one end of another package's transport; Python drives it like a link, with ``send``
    and ``close``. ``WAYS``: of a role, the names of what it sends and of what it receives."""

    port = None
    WAYS: ClassVar = {"controller": ("u", "y"), "plant": ("y", "u")}

    def __init__(self) -> None:
        self.arrived: list[bytes] = []  # of one whose package hands messages over by itself

    def receive(self) -> bytes | None:
        return self.arrived.pop(0) if self.arrived else None


def server_end(close: Callable[[], object]) -> PingPong:
    """The controller's end of a package whose server answers in a thread of its own."""
    return PingPong(lambda *_: -1, lambda stop: None, close, False)


def fresh_endpoint(link: str, folder: Path) -> str:
    """A new endpoint of a link."""
    folder = folder / link
    folder.mkdir(parents=True)
    return link_kind(link).fresh(folder)


def free_port() -> int:
    """A port of the loopback interface that is free for TCP, and most likely for UDP."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def memory_folder(stack: ExitStack) -> Path:
    """A folder that is removed with the stack, or with this process if it is killed; in memory if
    /dev/shm exists. Its path is short, since that of a Unix socket has at most 107 bytes."""
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    folder = tempfile.mkdtemp(prefix="gfmhil-", dir=memory)
    # if this process is killed, plant and controller write in the folder until they have ended
    remove = f'read _ || sleep {5 * GRACE_S}; rm -rf "$0"'
    guard = subprocess.Popen(
        ["sh", "-c", remove, folder], stdin=subprocess.PIPE, start_new_session=True
    )
    stack.callback(guard.communicate, b"\n")
    return Path(folder)
