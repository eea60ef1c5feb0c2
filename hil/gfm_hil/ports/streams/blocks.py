"""Blocks of all ticks, for our own tools: on the wire a block is a ``.npy`` file.

A message has two parts: the topic ``gfmhil/plant`` or ``gfmhil/controller``, and a record array
with the field ``tick``, the signals (float64) and the times (int64, ns, names with ``_ns``). Blocks
have a separate port: a client that subscribes to everything, as PlotJuggler does by default, gets
samples only.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from types import TracebackType

import numpy as np
import zmq
from numpy.typing import NDArray

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.ports.streams.follow import NewRows
from gfm_hil.recording.columns import SIGNALS_OF, TIMES_OF, recorded_in, signals_of

DEFAULT_ENDPOINT = "tcp://127.0.0.1:9873"
_TOPIC = "gfmhil/"
_MOST = 5000  # most rows per message: about 1 MB
_HEAD = 4096  # most bytes of a .npy file before its rows
ROOM = 500  # queued messages for a slow reader, at each end: 5 s of a run in real time


@dataclass(frozen=True)
class TickBlock:
    """Rows of one side.

    Attributes:
        role: ``"plant"`` or ``"controller"``.
        rows: record array, shape (n,); ``rows["tick"]`` shows gaps.
    """

    role: str
    rows: NDArray[np.void]


def block_dtype(role: Role, inner: bool = False) -> np.dtype:
    """The dtype of one row of a side; ``inner``: of a run with an inner stage."""
    signals, times = signals_of(role, inner), TIMES_OF[role]
    return np.dtype(
        [("tick", "<i8"), *((n, "<f8") for n in signals), *((f"{n}_ns", "<i8") for n in times)]
    )


def messages(rows: NewRows) -> list[list[bytes]]:
    """The messages that carry some rows."""
    columns = recorded_in(rows.role, rows.signals.shape[1])
    whole = np.empty(len(rows.signals), block_dtype(rows.role, columns != SIGNALS_OF[rows.role]))
    whole["tick"] = np.arange(rows.first, rows.first + len(whole))
    for j, name in enumerate(columns):
        whole[name] = rows.signals[:, j]
    for j, name in enumerate(TIMES_OF[rows.role]):
        whole[f"{name}_ns"] = rows.times[:, j]
    out = []
    for first in range(0, len(whole), _MOST):
        file = io.BytesIO()
        np.save(file, whole[first : first + _MOST], allow_pickle=False)
        out.append([f"{_TOPIC}{rows.role}".encode(), file.getvalue()])
    return out


class BlockReader:
    """Receives blocks; use as a context manager.

    Args:
        endpoint: the endpoint of blocks that ``gfmhil stream`` prints.
        role: ``"plant"`` or ``"controller"``; both if empty.
    """

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, role: str = "") -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, ROOM)
        self._socket.set(
            zmq.MAXMSGSIZE, _HEAD + _MOST * max(block_dtype(s, True).itemsize for s in ROLES)
        )
        self._socket.subscribe(f"{_TOPIC}{role}")
        self._socket.connect(endpoint)

    def __enter__(self) -> BlockReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._context.destroy(linger=0)

    def receive(self, timeout_s: float) -> TickBlock | None:
        """The next block, or None on timeout."""
        if not self._socket.poll(round(timeout_s * 1e3)):
            return None
        topic, payload = self._socket.recv_multipart()
        rows = np.load(io.BytesIO(payload), allow_pickle=False)
        return TickBlock(topic.decode().removeprefix(_TOPIC), rows)
