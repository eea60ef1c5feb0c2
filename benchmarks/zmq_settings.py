"""What each setting of the ZeroMQ link costs: round trips of the bench's frames.

Two processes on the processors of a run in real time call libzmq from compiled loops, as the link
does. Every setting has a pair of sockets of its own, open from the start, and the settings are
measured in interleaved rounds. The ratio is that of the median round trip to the link's own setting
(PAIR, ipc) in the same round.
"""

from __future__ import annotations

import argparse
import json
import os
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import zmq

from gfm_hil.bench.contenders import FRAME, free_port, memory_folder, messages
from gfm_hil.bench.pair import Policy, pair
from gfm_hil.bench.pingpong import PingPong, over_link
from gfm_hil.bench.rounds import in_turn, ratios, spread, spread_text
from gfm_hil.core.roles import Role
from gfm_hil.core.terminal import markdown
from gfm_hil.links.zeromq.curve import Curve, write_keys
from gfm_hil.links.zeromq.native import native_port
from gfm_hil.realtime.environment import environment
from gfm_hil.realtime.priority import PRIORITY

# messages and bytes, as in the link
ROOM = {zmq.SNDHWM: 64, zmq.RCVHWM: 64, zmq.SNDBUF: 16384, zmq.RCVBUF: 16384}
OWN = "PAIR, ipc"


@dataclass(frozen=True)
class Setting:
    """One way to set the sockets up; both processes open their end of it.

    Attributes:
        name: in the table.
        endpoint: where both meet.
        kind: of the sockets.
        options: of the sockets, by their number.
        context: options of the context, likewise; ``beside``: processors of which libzmq's thread
            gets the one that the loop has not.
        sleeps: waits in libzmq rather than by looking and yielding.
        keys: folder with the keys to encrypt by.
    """

    name: str
    endpoint: str
    kind: int = zmq.PAIR
    options: dict[int, int] = field(default_factory=dict)
    context: dict[int, int] = field(default_factory=dict)
    beside: tuple[int, ...] = ()
    sleeps: bool = False
    keys: Path | None = None

    def open(self, role: Role, payload: int) -> PingPong:
        """One end; the controller's first."""
        return over_link(_End(self, role), messages(role, payload))


class _End:
    """A socket with a port, for the loops of the benchmark."""

    def __init__(self, setting: Setting, role: Role) -> None:
        self._context = zmq.Context()
        for option, value in setting.context.items():
            self._context.set(option, value)
        for processor in set(setting.beside) - os.sched_getaffinity(0):
            self._context.set(zmq.THREAD_AFFINITY_CPU_ADD, processor)
        self._socket = self._context.socket(setting.kind)
        for option, value in {**ROOM, **setting.options}.items():
            self._socket.set(option, value)
        self._curve = Curve(self._socket, role, setting.keys) if setting.keys else None
        if role == "controller":
            self._socket.bind(setting.endpoint)
        else:
            self._socket.connect(setting.endpoint)
        port = native_port(self._socket)
        if port is None:
            raise SystemExit("pyzmq hides its libzmq: nothing to call")
        self.port = replace(port, receive=port.patient) if setting.sleeps else port

    def send(self, message: bytes) -> bool:
        """By pyzmq, as a link has to; the loops use the port."""
        self._socket.send(message)
        return True

    def receive(self) -> bytes | None:
        """Likewise."""
        return self._socket.recv()

    def close(self) -> None:
        self._socket.close(linger=0)
        if self._curve is not None:
            self._curve.close()
        self._context.term()


def settings(place: Path) -> list[Setting]:
    """What is compared, the link's own first; ``place`` is a folder in memory."""
    processors = tuple(sorted(os.sched_getaffinity(0))[:: max(1, len(os.sched_getaffinity(0)) - 1)])
    higher = {zmq.THREAD_SCHED_POLICY: os.SCHED_FIFO, zmq.THREAD_PRIORITY: PRIORITY + 10}
    keys = place / "keys"
    write_keys(keys)

    def ipc(name: str) -> str:
        return f"ipc://{place}/{name}"

    def tcp() -> str:
        return f"tcp://127.0.0.1:{free_port()}"

    return [
        Setting(OWN, ipc("own")),
        Setting("DEALER", ipc("dealer"), kind=zmq.DEALER),
        Setting("`IMMEDIATE`", ipc("immediate"), options={zmq.IMMEDIATE: 1}),
        Setting("I/O thread at a higher priority", ipc("higher"), context=higher),
        Setting("I/O thread on the other processor", ipc("beside"), beside=processors),
        Setting("sleeping instead of yielding", ipc("sleeps"), sleeps=True),
        Setting("tcp", tcp()),
        Setting("tcp with CURVE", tcp(), keys=keys),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each (%(default)s)")
    parser.add_argument("--seconds", type=float, default=0.3, help="of a round (%(default)s)")
    parser.add_argument("--policy", choices=("fifo", "other"), default="fifo", help="of both loops")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args()
    medians, silent = measure(args.policy, args.rounds, args.seconds)
    by_own = {name: ratios(found, medians[OWN]) for name, found in medians.items() if found}
    if args.json:
        plain = {
            name: {"p50_us": spread(medians[name]), "ratio": spread(each)}
            for name, each in by_own.items()
        }
        about = {"policy": args.policy, "silent": silent, "environment": environment()}
        print(json.dumps({"settings": plain, **about}, indent=2))
        return
    rows = [(n, spread_text(medians[n], 1), spread_text(x, 2)) for n, x in by_own.items()]
    print(markdown(("setting", "p50, µs", "ratio"), rows))
    print(*(f"{name}: a side fell silent" for name in silent), sep="\n")


def measure(
    policy: Policy, rounds: int, seconds: float
) -> tuple[dict[str, list[float]], list[str]]:
    """Median round trip of each round in µs, by setting; and the settings that fell silent."""
    with ExitStack() as stack:
        place = memory_folder(stack)
        found = settings(place)
        two = stack.enter_context(pair(policy, place))
        for setting in found:
            two.open(setting, FRAME)
            two.round(setting, 0, seconds)  # to compile and to warm up
        medians: dict[str, list[float]] = {setting.name: [] for setting in found}
        silent = set()
        for _, _, setting in in_turn(found, rounds):
            times = two.round(setting, 0, seconds)
            if len(times):
                medians[setting.name].append(float(np.median(times)) * 1e-3)
            else:
                silent.add(setting.name)
    return {n: m for n, m in medians.items() if n not in silent}, sorted(silent)


if __name__ == "__main__":
    main()
