"""Round trips by each link's own client, and by a client in C, written from the pages alone.

The same loop of the bench answers both. A ratio near 1 says that the bench measures the exchange,
and not itself. cantools makes the packing of the CAN client from the DBC. Both clients run in the
process of the plant's side, on its processor and at its priority, in interleaved rounds; a ratio is
taken within a round.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import socket
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import zmq
from cantools.database.can.c_source import generate
from zmq.backend.cython import _zmq

from gfm_hil.bench.c_code import compile_c
from gfm_hil.bench.contenders import (
    FRAME,
    Contender,
    free_port,
    fresh_endpoint,
    memory_folder,
    of_link,
)
from gfm_hil.bench.pair import Policy, pair
from gfm_hil.bench.pingpong import Messages, Numbers, PingPong, over_link
from gfm_hil.bench.rounds import in_turn, ratios, spread, spread_text
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.terminal import markdown
from gfm_hil.links import open_link
from gfm_hil.links.can.dbc import read_dbc, write_dbc
from gfm_hil.links.can.layout import plan_of
from gfm_hil.links.ring import IN, IN_HEAD, OUT, OUT_HEAD
from gfm_hil.links.zeromq.link import pair_socket
from gfm_hil.realtime.environment import environment

SHM, ZMQ, SERIAL, CAN = range(4)
IN_C = ", client in C"

Opened = list[int]  # numbers for the client in C; what is open belongs to the stack


def _open_shm(endpoint: str, keep: ExitStack) -> Opened:
    link = open_link("shm", "plant", endpoint)
    keep.callback(link.close)
    link.receive()  # joins the segment
    assert link.port is not None
    return [SHM, *(int(link.port.handle[k]) for k in (OUT, OUT_HEAD, IN, IN_HEAD))]


def _open_zmq(endpoint: str, keep: ExitStack) -> Opened:
    end = keep.enter_context(pair_socket(keep.enter_context(zmq.Context())))
    end.set(zmq.LINGER, 0)
    end.connect(endpoint)
    library = ctypes.CDLL(_zmq.__file__)
    calls = (
        ctypes.cast(f, ctypes.c_void_p).value or 0 for f in (library.zmq_send, library.zmq_recv)
    )
    return [ZMQ, end.underlying, *calls]


def _open_serial(endpoint: str, keep: ExitStack) -> Opened:
    link = open_link("serial", "plant", endpoint)
    keep.callback(link.close)
    link.receive()  # opens the line
    return [SERIAL, link.fileno(), link.fileno()]


def _open_can(endpoint: str, keep: ExitStack) -> Opened:
    port = int(endpoint.rpartition(":")[2])
    own, other = (
        keep.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in ROLES
    )
    own.bind(("127.0.0.1", port + ROLES.index("plant")))
    other.connect(("127.0.0.1", port + ROLES.index("controller")))
    plan = plan_of(read_dbc(write_dbc(True)))
    ids = [plan.vectors[group][0].data_id for group in ("y", "u")]
    return [CAN, own.fileno(), other.fileno(), *ids]


_OPENERS: dict[str, Callable[[str, ExitStack], Opened]] = {
    "shm": _open_shm, "zmq": _open_zmq, "serial": _open_serial, "can": _open_can,
}  # fmt: skip


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    """The controller's end is that of the link, the plant's is the client in C."""
    if role == "controller":
        return over_link(open_link(c.link, role, c.endpoint), own)
    keep = ExitStack()
    opened = np.array(_OPENERS[c.link](c.endpoint, keep), np.int64)
    assert c.library is not None
    library = ctypes.CDLL(str(c.library))
    client = np.zeros(ctypes.c_int64.in_dll(library, "SIZE_OF_CLIENT").value, np.uint8)
    array = partial(np.ctypeslib.ndpointer, flags="C")
    library.exchange.restype = ctypes.c_int64
    library.exchange.argtypes = [
        array(np.uint8), array(np.int64), array(np.uint8), *[ctypes.c_int64] * 3, array(np.int64),
        ctypes.c_int64,
    ]  # fmt: skip

    def ping(stop: Numbers, period_ns: int, duration_ns: int, took: Numbers) -> int:
        count, size = own.shape
        return int(library.exchange(client, opened, own, count, size, duration_ns, took, len(took)))

    return PingPong(ping, lambda stop: None, keep.close, True)


def candidates(links: list[str], place: Path) -> list[tuple[Contender, Contender]]:
    """Of each link its own client, and that in C; ``place`` is a folder in memory."""
    names = "can_link.h", "can_link.c"
    texts = generate(read_dbc(write_dbc(True)), "can_link", *names, "")
    for name, text in zip(names, texts, strict=False):  # it makes files for fuzzing, too
        (place / name).write_text(text, encoding="utf-8")
    source = Path(__file__).with_suffix(".c")
    library = compile_c(source, place, "independent", more=[place / "can_link.c"])
    both = []
    for name in links:
        link, over_tcp = name.split()[0], name.endswith("tcp")
        own, other = (
            f"tcp://127.0.0.1:{free_port()}" if over_tcp else fresh_endpoint(link, place / part)
            for part in ("own", "c")
        )
        in_c = Contender(name + IN_C, link, other, _open, "C", longest=FRAME, library=library)
        both.append((of_link(name, link, own, ""), in_c))
    return both


def measure(
    links: list[str], policy: Policy, rounds: int, seconds: float
) -> dict[str, list[float]]:
    """Median round trip of each round in µs, by contender."""
    with ExitStack() as stack:
        place = memory_folder(stack)
        each = [one for both in candidates(links, place) for one in both]
        two = stack.enter_context(pair(policy, place))
        for one in each:
            two.open(one, FRAME)
            two.round(one, 0, seconds)  # to compile and to warm up
        medians: dict[str, list[float]] = {one.name: [] for one in each}
        for _, _, one in in_turn(each, rounds):
            times = two.round(one, 0, seconds)
            if not len(times):
                raise SystemExit(f"{one.name}: no answer")
            medians[one.name].append(float(np.median(times)) * 1e-3)
    return medians


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--links", default="shm,zmq ipc,zmq tcp,can,serial", help="by commas (%(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=25, help="rounds of each (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.3, help="of a round (%(default)s)")
    parser.add_argument("--policy", choices=("fifo", "other"), default="fifo", help="of both loops")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    links = args.links.split(",")
    medians = measure(links, args.policy, args.rounds, args.seconds)
    by_c = {name: ratios(medians[name], medians[name + IN_C]) for name in links}
    if args.json:
        rows = {
            n: {
                "p50_us": spread(medians[n]),
                "in_c_us": spread(medians[n + IN_C]),
                "ratio": spread(x),
            }
            for n, x in by_c.items()
        }
        about = {"policy": args.policy, "environment": environment()}
        print(json.dumps({"links": rows, **about}, indent=2))
        return
    lines = [
        (n, spread_text(medians[n], 2), spread_text(medians[n + IN_C], 2), spread_text(x, 3))
        for n, x in by_c.items()
    ]
    print(markdown(("link", "its client, p50 µs", "client in C, p50 µs", "ratio"), lines))


if __name__ == "__main__":
    main()
