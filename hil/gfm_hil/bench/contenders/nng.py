"""NNG, by the package pynng."""

from collections.abc import Iterator
from pathlib import Path

from gfm_hil.bench.contenders import Contender, PackageEnd, free_port
from gfm_hil.bench.contenders.ours import ZMQ_IPC, ZMQ_TCP
from gfm_hil.bench.pingpong import Messages
from gfm_hil.core.roles import Role


def contenders(folder: Path) -> Iterator[Contender]:
    ipc, tcp = f"ipc://{folder}/nng", f"tcp://127.0.0.1:{free_port()}"
    yield Contender("nng ipc", "nng", ipc, Nng, "pynng", limit=ZMQ_IPC)
    yield Contender("nng tcp", "nng", tcp, Nng, "pynng", limit=ZMQ_TCP)


class Nng(PackageEnd):
    """One end of a PAIR socket that the caller polls, without Nagle's algorithm."""

    def __init__(self, c: Contender, role: Role, own: Messages) -> None:
        import pynng

        self._socket, self._no_message = pynng.Pair0(), pynng.TryAgain
        if c.endpoint.startswith("tcp"):
            self._socket.tcp_nodelay = True
        if role == "controller":
            self._socket.listen(c.endpoint)
        else:
            self._socket.dial(c.endpoint, block=True)

        self.send, self.close = self._socket.send, self._socket.close

    def receive(self) -> bytes | None:
        try:
            return bytes(self._socket.recv(block=False))
        except self._no_message:
            return None
