"""NNG, by the package pynng."""

from collections.abc import Iterator
from pathlib import Path

from gfm_hil.bench.contenders import Contender, PackageEnd, free_port, of_package
from gfm_hil.bench.contenders.ours import ZMQ_IPC, ZMQ_TCP
from gfm_hil.core.roles import Role


def contenders(folder: Path) -> Iterator[Contender]:
    ipc, tcp = f"ipc://{folder}/nng", f"tcp://127.0.0.1:{free_port()}"
    yield of_package("nng ipc", ipc, Nng, "pynng", ZMQ_IPC)
    yield of_package("nng tcp", tcp, Nng, "pynng", ZMQ_TCP)


class Nng(PackageEnd):
    """One end of a PAIR socket that the caller polls, without Nagle's algorithm."""

    def __init__(self, role: Role, endpoint: str) -> None:
        import pynng

        self._socket, self._no_message = pynng.Pair0(), pynng.TryAgain
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
        except self._no_message:
            return None

    def close(self) -> None:
        self._socket.close()
