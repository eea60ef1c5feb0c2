"""The link ``zmq`` over ipc and tcp and without its port, and its limits: C on the same libzmq."""

import ctypes
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gfm_hil.bench.contenders import Contender, free_port, fresh_endpoint, limit, of_link
from gfm_hil.bench.pingpong import Messages, PingPong, in_c
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST

IPC, TCP = "C zmq ipc", "C zmq tcp"


def contenders(names: Sequence[str], folder: Path) -> Iterator[Contender]:
    ipc, tcp = fresh_endpoint("zmq", folder), "tcp://127.0.0.1"
    yield limit(IPC, __file__, f"{ipc}-c", _open, LONGEST)
    yield limit(TCP, __file__, f"{tcp}:{free_port()}", _open, LONGEST)
    if "zmq" in names:
        yield of_link("zmq ipc", "zmq", ipc, IPC)
        yield of_link("zmq ipc, portable", "zmq", f"{ipc}-portable", IPC, portable=True)
        yield of_link("zmq tcp", "zmq", f"{tcp}:{free_port()}", TCP)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    """A socket with the link's options, of the library that pyzmq has loaded. Raises UserError: its
    functions cannot be found."""
    import zmq
    from zmq.backend.cython import _zmq

    from gfm_hil.links.zeromq.link import pair_socket

    libzmq = ctypes.CDLL(_zmq.__file__)  # resolves the library that it is linked to
    try:
        functions = libzmq.zmq_send, libzmq.zmq_recv
    except AttributeError:
        raise UserError("pyzmq hides its libzmq: nothing for C to call") from None
    keep = ExitStack()
    end = keep.enter_context(pair_socket(keep.enter_context(zmq.Context())))
    end.set(zmq.LINGER, 0)
    if role == "controller":
        end.bind(c.endpoint)
    else:
        end.connect(c.endpoint)
    call = [ctypes.cast(function, ctypes.c_void_p).value or 0 for function in functions]
    return in_c(c.library, [end.underlying, *call], own.shape[1], keep)
