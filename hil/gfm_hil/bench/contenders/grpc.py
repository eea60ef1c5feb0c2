"""gRPC, by the package grpcio: unary calls of plain bytes over a Unix socket."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from gfm_hil.bench.contenders import Contender, PackageEnd, server_end
from gfm_hil.bench.contenders.ours import UDP
from gfm_hil.bench.pingpong import Messages, PingPong
from gfm_hil.core.roles import Role

_SERVICE, _METHOD = "gfmhil", "exchange"
_START_S = 10.0


def contenders(folder: Path) -> Iterator[Contender]:
    yield Contender("grpc", "grpc", f"unix:{folder}/grpc", _open, "grpcio", limit=UDP)


def _open(c: Contender, role: Role, own: Messages) -> PingPong | PackageEnd:
    """The controller is the server: u answers the call that brings y. Its guide to performance
    prefers unary calls to streams in Python, which need more threads."""
    return _server(c.endpoint, own) if role == "controller" else _Stub(c.endpoint)


class _Stub(PackageEnd):
    """The plant's end: it calls and has the answer before it polls for one."""

    def __init__(self, endpoint: str) -> None:
        import grpc

        super().__init__()
        self._channel = grpc.insecure_channel(endpoint)
        grpc.channel_ready_future(self._channel).result(_START_S)
        self._call = self._channel.unary_unary(f"/{_SERVICE}/{_METHOD}")

        self.close = self._channel.close

    def send(self, message: bytes) -> None:
        self.arrived.append(self._call(message))


def _server(endpoint: str, own: Messages) -> PingPong:
    """A server that answers in a thread of its own."""
    import grpc

    answers = [row.tobytes() for row in own]
    calls = iter(range(1 << 62))

    def exchange(request: bytes, context: Any) -> bytes:
        return answers[next(calls) % len(answers)]

    server = grpc.server(ThreadPoolExecutor(1))
    handlers = {_METHOD: grpc.unary_unary_rpc_method_handler(exchange)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_SERVICE, handlers),))
    server.add_insecure_port(endpoint)
    server.start()
    return server_end(lambda: server.stop(None).wait())
