"""The bench's own share of a round trip: the same loops over a link that takes no time.

There the answer is back at the first look. What remains is reading the clock, copying a message,
and, with frames whose clocks are compared, their CRCs on both sides.
"""

import numpy as np

from gfm_hil.bench.exchange import frames, send_all
from gfm_hil.bench.one_way import RECEIVED, SENT
from gfm_hil.bench.pingpong import frames as messages
from gfm_hil.bench.pingpong import over_link
from gfm_hil.links.frame import FrameWriter, is_sealed, seal
from gfm_hil.links.port import Port, port_function
from gfm_runtime.signals import NU, NY

_TIMES, _ROUND_NS = 2000, 100_000_000
# words of the handle: whether a message is under way, and frames are; bytes of the answer; whether
# the CRC of y is right
_HERE, _FRAMES, _SIZE, _GOOD = range(4)
_ANSWER = 8  # word at which the answer begins
_TICK = slice(12, 20)  # bytes of a frame


@port_function
def _send(handle, message):
    handle[_HERE] = 1
    if handle[_FRAMES] != 0:
        answer = handle[_ANSWER:].view(np.uint8)[: handle[_SIZE]]
        answer[_TICK] = message[_TICK]
        handle[_GOOD] = is_sealed(message)
        seal(answer)
    return 1


@port_function
def _receive(handle, message):
    if handle[_HERE] == 0:
        return 0
    handle[_HERE] = 0
    answer, size = handle[_ANSWER:].view(np.uint8), handle[_SIZE]
    for k in range(size):
        message[k] = answer[k]
    return size


def _mirror(of_frames: bool) -> Port:
    """The port of a link whose answer is back at once."""
    answer = FrameWriter("u").pack(0, 1, 0, np.ones(NU))
    handle = np.zeros(_ANSWER + 8, np.int64)
    handle[_FRAMES], handle[_SIZE] = of_frames, len(answer)
    handle[_ANSWER:].view(np.uint8)[: len(answer)] = np.frombuffer(answer, np.uint8)
    return Port(handle, _send, _receive, 1000)


class _Mirror:
    """The same link, without a port unless there is one to give."""

    def __init__(self, port: Port | None = None) -> None:
        self.port = port
        self._came: list[bytes] = []
        self.send = self._came.append
        self.close = self._came.clear

    def receive(self) -> bytes | None:
        return self._came.pop() if self._came else None


def own_share_us(code: str, of_frames: bool) -> float:
    """The median over exchanges in one process, µs; ``code`` as in the tables, ``compiled`` or
    ``Python``; ``of_frames``: with those that ``exchange`` checks."""
    if of_frames:
        port, stamps = _mirror(True), np.zeros((_TIMES, 5), np.int64)
        n = send_all(
            port.handle, port.send, port.receive, port.spins, frames("y"),
            frames("u", clocks=True), np.ones(NY), 0, _ROUND_NS, _ROUND_NS, 0, stamps,
        )  # fmt: skip
        took = stamps[:, RECEIVED] - stamps[:, SENT]
    else:
        took = np.zeros(_TIMES, np.int64)
        end = over_link(_Mirror(_mirror(False) if code == "compiled" else None), messages("y"))
        n = end.ping(np.zeros(3, np.int64), 0, _ROUND_NS, took)
    return round(float(np.median(took[:n])) / 1e3, 4)
