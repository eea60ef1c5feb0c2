"""Every link that has no file of its own, and their limit: UDP in C on the loopback interface."""

import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gfm_hil.bench import contenders as of
from gfm_hil.bench.pingpong import Messages, PingPong, in_c
from gfm_hil.core.roles import Role

LIMIT = "C udp"


def contenders(names: Sequence[str], folder: Path) -> Iterator[of.Contender]:
    yield of.limit(LIMIT, __file__, f"{of.free_port()},{of.free_port()}", _open)
    for link in [name for name in names if name not in of.FILES and name not in of.PEERS]:
        yield of.of_link(link, link, of.fresh_endpoint(link, folder), LIMIT)


def _open(c: of.Contender, role: Role, own: Messages) -> PingPong:
    """The endpoint has the ports of the controller and of the plant."""
    keep = ExitStack()
    end = keep.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    ports = [int(port) for port in c.endpoint.split(",")]
    mine, peer = ports if role == "controller" else ports[::-1]
    end.bind(("127.0.0.1", mine))
    end.connect(("127.0.0.1", peer))
    return in_c(c.library, [end.fileno()], own.shape[1], keep)
