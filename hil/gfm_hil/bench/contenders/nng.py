"""NNG, by the package pynng."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from gfm_hil.bench.contenders import Contender, free_port, zmq
from gfm_hil.bench.pingpong import Messages, PingPong, over_link
from gfm_hil.core.roles import Role
from gfm_hil.links.port import Port


def contenders(names: Sequence[str], place: Path) -> Iterator[Contender]:
    if "nng" in names:
        ipc, tcp = f"ipc://{place}/nng", f"tcp://127.0.0.1:{free_port()}"
        yield Contender("nng ipc", "nng", ipc, _open, "pynng", limit=zmq.IPC)
        yield Contender("nng tcp", "nng", tcp, _open, "pynng", limit=zmq.TCP)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    return over_link(Nng(role, c.endpoint), own)


class Nng:
    """One end of a PAIR socket that the caller polls, without Nagle's algorithm."""

    port: Port | None = None

    def __init__(self, role: Role, endpoint: str) -> None:
        import pynng

        self._socket, self._nothing = pynng.Pair0(), pynng.TryAgain
        if endpoint.startswith("tcp"):
            self._socket.tcp_nodelay = True
        if role == "controller":
            self._socket.listen(endpoint)
        else:
            self._socket.dial(endpoint, block=True)

    def send(self, message: bytes) -> bool:
        self._socket.send(message)
        return True

    def receive(self) -> bytes | None:
        try:
            return bytes(self._socket.recv(block=False))
        except self._nothing:
            return None

    def close(self) -> None:
        self._socket.close()
