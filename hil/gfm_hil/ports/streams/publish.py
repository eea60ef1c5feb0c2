"""The publisher beside a run: polls for new rows and sends them to subscribers."""

from __future__ import annotations

import time
from collections.abc import Callable

import zmq

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.supervised import attempt
from gfm_hil.ports.streams.blocks import ROOM, messages
from gfm_hil.ports.streams.follow import Follower
from gfm_hil.ports.streams.samples import Sampler

_LOOK_S = 0.02
_LINGER_MS = 500  # to send the last messages
_LONGEST = 256  # bytes of a subscription; ours have 17
_WAITING = 100  # queued subscription messages per subscriber


class Publisher:
    """Both sockets, bound; use as a context manager.

    Args:
        host: address to listen at.
        samples, blocks: ports, 0: a free one.

    Raises:
        UserError: a port cannot be bound.
    """

    def __init__(self, host: str, samples: int, blocks: int) -> None:
        self._context = zmq.Context()
        try:
            self._samples = _bind(self._context, host, samples, "--port")
            self._blocks = _bind(self._context, host, blocks, "--blocks")
        except UserError:
            self._context.destroy(linger=0)
            raise
        self.samples, self.blocks = (
            socket.get_string(zmq.LAST_ENDPOINT) for socket in (self._samples, self._blocks)
        )

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=_LINGER_MS)

    def follow(self, follower: Follower, rate: float, stopped: Callable[[], bool]) -> int:
        """Send a run's rows, and ``rate`` samples per second, until it ends or ``stopped()``.

        Returns:
            How many ticks of the plant (without a plant: of the controller) were sent.
        """
        sampler = Sampler(follower.T_s, rate, follower.misses_before())
        count: dict[Role, int] = dict.fromkeys(ROLES, 0)
        looked = time.monotonic()

        def look() -> None:
            nonlocal looked
            before, looked = looked, time.monotonic()
            for rows in follower.news():
                count[rows.role] += len(rows.signals)
                for message in sampler.messages(rows, looked - before):
                    self._samples.send_multipart(message)
                for message in messages(rows):
                    self._blocks.send_multipart(message)

        while not follower.over and not stopped():
            time.sleep(_LOOK_S)
            attempt("the stream's look at the run", look)
        return count["plant"] or count["controller"]


def _bind(
    context: zmq.Context[zmq.Socket[bytes]], host: str, port: int, option: str
) -> zmq.Socket[bytes]:
    socket = context.socket(zmq.PUB)
    socket.set(zmq.MAXMSGSIZE, _LONGEST)
    socket.set(zmq.RCVHWM, _WAITING)
    socket.set(zmq.SNDHWM, ROOM)
    where = f"tcp://{f'[{host}]' if ':' in host else host}:{port or '*'}"
    try:
        socket.set(zmq.IPV6, int(":" in host))
        socket.bind(where)
    except zmq.ZMQError as problem:
        raise UserError(f"{option} {port}: {where}: {zmq.strerror(problem.errno or 0)}") from None
    return socket
