"""The publisher beside a run: looks what is new, and sends it to whoever listens."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import zmq

from gfm_hil.errors import UserError
from gfm_hil.telemetry import blocks
from gfm_hil.telemetry.follow import Follower
from gfm_hil.telemetry.samples import Sampler

_LOOK_S = 0.02
_LINGER_MS = 500  # for what is still to leave in the end


@dataclass(frozen=True)
class Ports:
    """Where to be found: address, and ports of samples and blocks (0: a free one)."""

    host: str
    samples: int
    blocks: int


def publish(
    follower: Follower,
    ports: Ports,
    rate: float,
    ready: Callable[[str, str], None],
    stopped: Callable[[], bool],
) -> int:
    """Send on what a run records, to its end; returns how many ticks of the plant or, without
    it, of the controller were sent.

    Args:
        follower: of the run.
        ports: to listen on.
        rate: samples a second.
        ready: told the endpoints of samples and blocks.
        stopped: whether to end before the run does.

    Raises:
        UserError: a port is not to be had.
    """
    context = zmq.Context()
    try:
        samples = _bind(context, ports.host, ports.samples, "--port")
        raw = _bind(context, ports.host, ports.blocks, "--blocks")
        ready(_endpoint(samples), _endpoint(raw))
        sampler = Sampler(follower.T_s, rate, follower.misses_before())
        count = dict.fromkeys(("plant", "controller"), 0)
        looked = time.monotonic()
        while not follower.over and not stopped():
            time.sleep(_LOOK_S)
            now = time.monotonic()
            for rows in follower.news():
                count[rows.side] += len(rows.signals)
                for message in sampler.messages(rows, now - looked):
                    samples.send_multipart(message)
                for message in blocks.messages(rows):
                    raw.send_multipart(message)
            looked = now
        return count["plant"] or count["controller"]
    finally:
        context.destroy(linger=_LINGER_MS)


def _bind(
    context: zmq.Context[zmq.Socket[bytes]], host: str, port: int, option: str
) -> zmq.Socket[bytes]:
    socket = context.socket(zmq.PUB)
    where = f"tcp://{f'[{host}]' if ':' in host else host}:{port or '*'}"
    try:
        socket.set(zmq.IPV6, int(":" in host))
        socket.bind(where)
    except zmq.ZMQError as problem:
        raise UserError(f"{option} {port}: {where}: {problem}") from None
    return socket


def _endpoint(socket: zmq.Socket[bytes]) -> str:
    return socket.get_string(zmq.LAST_ENDPOINT)
