"""Every link that has no file of its own, and their limit: UDP in C on the loopback interface."""

import socket
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gfm_hil.bench.contenders import (
    FILES,
    PEERS,
    Contender,
    free_port,
    fresh_endpoint,
    limit,
    of_link,
)
from gfm_hil.bench.pingpong import Messages, PingPong, in_c
from gfm_hil.core.roles import Role

LIMIT = "C udp"


def contenders(names: Sequence[str], folder: Path) -> Iterator[Contender]:
    yield limit(LIMIT, __file__, f"{free_port()},{free_port()}", _open)
    for link in [name for name in names if name not in FILES and name not in PEERS]:
        yield of_link(link, link, fresh_endpoint(link, folder), LIMIT)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    """The endpoint has the ports of the controller and of the plant."""
    keep = ExitStack()
    end = keep.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    ports = [int(port) for port in c.endpoint.split(",")]
    mine, peer = ports if role == "controller" else ports[::-1]
    end.bind(("127.0.0.1", mine))
    end.connect(("127.0.0.1", peer))
    return in_c(c.library, [end.fileno()], own.shape[1], keep)
