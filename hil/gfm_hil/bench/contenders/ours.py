"""The links of the bench, and their limits: the same exchange in C, in the ``.c`` files here."""

import ctypes
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from gfm_hil.bench.contenders import PEERS, Contender, free_port, fresh_endpoint, of_link
from gfm_hil.bench.pingpong import Messages, Numbers, PingPong
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links import open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.serial.link import SerialLink

UDP, SHM, ZMQ_IPC, ZMQ_TCP, SERIAL = "C udp", "C shm", "C zmq ipc", "C zmq tcp", "C serial"
_SLOTS = 2 * 1024  # bytes of shared memory, two slot_t


def contenders(names: Sequence[str], folder: Path) -> Iterator[Contender]:
    """In the order of the tables; a link that has no limit of its own is beside that of UDP."""
    yield _limit(UDP, f"{free_port()},{free_port()}", _udp, 65507)
    for name in names:
        if name not in (*PEERS, "shm", "zmq", "serial"):
            yield of_link(name, name, fresh_endpoint(name, folder), UDP)
    yield _limit(SHM, str(folder / "slots"), _shm)
    if "shm" in names:
        yield of_link("shm", "shm", fresh_endpoint("shm", folder), SHM)
    ipc, tcp = fresh_endpoint("zmq", folder), "tcp://127.0.0.1"
    yield _limit(ZMQ_IPC, f"{ipc}-c", _zmq)
    yield _limit(ZMQ_TCP, f"{tcp}:{free_port()}", _zmq)
    if "zmq" in names:
        yield of_link("zmq ipc", "zmq", ipc, ZMQ_IPC)
        yield of_link("zmq ipc, portable", "zmq", f"{ipc}-portable", ZMQ_IPC, portable=True)
        yield of_link("zmq tcp", "zmq", f"{tcp}:{free_port()}", ZMQ_TCP)
    if "serial" in names:
        yield _limit(SERIAL, fresh_endpoint("serial", folder / "c"), _serial)
        yield of_link("serial", "serial", fresh_endpoint("serial", folder), SERIAL)


# What opens an end of a limit returns the numbers and addresses that ``open_end`` of its C source
# takes, and keeps what is to be freed with the end.


def _udp(endpoint: str, role: Role, keep: ExitStack) -> list[int]:
    """The endpoint has the ports of the controller and of the plant."""
    end = keep.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    ports = [int(port) for port in endpoint.split(",")]
    mine, peer = ports if role == "controller" else ports[::-1]
    end.bind(("127.0.0.1", mine))
    end.connect(("127.0.0.1", peer))
    return [end.fileno()]


def _shm(endpoint: str, role: Role, keep: ExitStack) -> list[int]:
    """A file that both sides map."""
    if role == "controller":
        Path(endpoint).write_bytes(bytes(_SLOTS))
    slots = np.memmap(endpoint, np.uint8, "r+")
    keep.callback(slots.flush)  # keeps the mapping alive with the end
    return [slots.ctypes.data, int(role == "controller")]


def _zmq(endpoint: str, role: Role, keep: ExitStack) -> list[int]:
    """A socket with the link's options, of the library that pyzmq has loaded. Raises UserError: its
    functions cannot be found."""
    import zmq
    from zmq.backend.cython import _zmq as bound

    from gfm_hil.links.zeromq.link import pair_socket

    libzmq = ctypes.CDLL(bound.__file__)  # resolves the library that it is linked to
    try:
        functions = libzmq.zmq_send, libzmq.zmq_recv
    except AttributeError:
        raise UserError("pyzmq hides its libzmq: nothing for C to call") from None
    end = keep.enter_context(pair_socket(keep.enter_context(zmq.Context())))
    end.set(zmq.LINGER, 0)
    (end.bind if role == "controller" else end.connect)(endpoint)
    call = [ctypes.cast(function, ctypes.c_void_p).value or 0 for function in functions]
    return [end.underlying, *call]


def _serial(endpoint: str, role: Role, keep: ExitStack) -> list[int]:
    end = open_link("serial", role, endpoint)
    keep.callback(end.close)
    assert isinstance(end, SerialLink)
    return [end.fileno()]


def _limit(
    name: str, endpoint: str, opened: Callable[[str, Role, ExitStack], list[int]],
    longest: int = LONGEST,
) -> Contender:  # fmt: skip
    link = name.split()[1]
    source = Path(__file__).with_name(f"{link}.c")
    options = {"opened": opened}
    return Contender(name, link, endpoint, _open, "C", options, name, longest, source)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    keep = ExitStack()
    numbers = np.array(c.options["opened"](c.endpoint, role, keep), np.int64)
    size = own.shape[1]
    library = ctypes.CDLL(str(c.library))  # calls release the interpreter's lock
    number, address = ctypes.c_int64, np.ctypeslib.ndpointer(np.int64, 1)
    library.ping.argtypes = [address, *[number] * 3, address, number]
    library.pong.argtypes = [address, number, address]
    library.ping.restype, library.pong.restype = number, None

    def ping(stop: Numbers, period_ns: int, duration_ns: int, took: Numbers) -> int:
        return int(library.ping(numbers, size, period_ns, duration_ns, took, len(took)))

    return PingPong(ping, lambda stop: library.pong(numbers, size, stop), keep.close, True)
