"""What a stream sends of new rows: samples of a few ticks, and blocks of all of them.

A message has two parts, topic and payload. The topic is ``gfmhil/plant`` or ``gfmhil/controller``;
in a network the name of the converter comes between, as in ``gfmhil/A/plant``.

- A sample, in the format that PlotJuggler's ZeroMQ subscriber reads by default, is a JSON object
  whose numbers become series named by their path, such as ``gfmhil/plant/y/p``. Its number
  ``timestamp`` is the sample's time if PlotJuggler is set to use the field; else it uses the time
  of arrival. A third part could hold the time too, but corrupts the payload in PlotJuggler (its
  pull request 1416).
- A block, for our own tools, is a ``.npy`` file: a record array with the field ``tick``, the
  signals (float64) and the times (int64, ns, names with ``_ns``). Blocks have a separate port: a
  client that subscribes to everything, as PlotJuggler does by default, gets samples only.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.recording.columns import ALL_COLUMNS, TIMES_OF, Columns, named, recorded_in
from gfm_hil.recording.timing import SLACK, missed

DEFAULT_ENDPOINT = "tcp://127.0.0.1:9873"
_TOPIC = "gfmhil/"
_MOST = 5000  # most rows per message: about 1 MB
_HEAD = 4096  # most bytes of a .npy file before its rows
ROOM = 500  # queued messages for a slow reader, at each end: 5 s of a run in real time
_GROUPS = ("y", "u", "true", "ref")  # prefixes of columns that become objects in a sample


@dataclass(frozen=True)
class NewRows:
    """Rows of one side, as in ``recording.parts.RolePart``."""

    role: Role  # ``"plant"`` or ``"controller"``
    first: int  # tick of the first row
    # shape (n, columns), the units of the recording; NaN in ticks never recorded
    signals: NDArray[np.float64]
    times: NDArray[np.int64]  # shape (n, columns), int64, ns
    converter: str = ""  # of a network: its name

    @property
    def topic(self) -> bytes:
        """Under which messages of them are sent."""
        return f"{_topic(self.converter)}{self.role}".encode()

    @property
    def columns(self) -> Columns:
        """The same by the names of the columns in a run folder."""
        return named(self.role, self.signals, self.times)


def _topic(converter: str) -> str:
    """How the topics of a network's converter begin, or of a run without a network."""
    return f"{_TOPIC}{converter}/" if converter else _TOPIC


@cache
def _places(role: Role, width: int) -> list[tuple[str, str]]:
    """Object and name in a sample of each column; the object is empty for a top-level column."""
    parts = [(name, *name.partition("_")[::2]) for name in recorded_in(role, width)]
    return [(group, rest) if group in _GROUPS else ("", name) for name, group, rest in parts]


class Sampler:
    """Takes every n-th tick.

    Args:
        T_s: sampling time of the run, s.
        rate: samples per second, both of the run's time and of real time.
        misses: number of misses before the first row.
    """

    def __init__(self, T_s: float, rate: float, misses: int) -> None:
        self.T_s, self._misses = T_s, misses
        self._every = max(1, round(1 / (T_s * rate)))
        self._least = math.nan  # least slack since the last sample, µs

    def messages(self, rows: NewRows, seconds: float) -> list[list[bytes]]:
        """The samples of rows that were recorded in ``seconds``; of a run faster than real time
        there are fewer."""
        faster = round(len(rows.signals) * self.T_s / seconds)  # factor against real time
        every = self._every * max(1, faster)
        plant, out, begin = rows.role == "plant", [], 0
        if plant:
            misses = self._misses + np.cumsum(missed(rows.columns))
            self._misses = int(misses[-1])
            slack = SLACK.us(rows.columns, self.T_s)
        for k in range(-rows.first % every, len(rows.signals), every):
            values = rows.signals[k].tolist()
            if math.isnan(values[0]):  # a tick whose frame was lost
                continue
            sample = self._sample(rows, k, values)
            if plant:
                sample["misses"] = int(misses[k])
                least = float(np.fmin.reduce(slack[begin : k + 1], initial=self._least))
                if math.isfinite(least):
                    sample["slack_us"] = round(least, 3)
                self._least, begin = math.nan, k + 1
            out.append([rows.topic, json.dumps(sample).encode()])
        if plant:
            self._least = float(np.fmin.reduce(slack[begin:], initial=self._least))
        return out

    def _sample(self, rows: NewRows, k: int, values: list[float]) -> dict[str, Any]:
        """One tick's numbers; JSON cannot hold NaN or infinity."""
        tick = rows.first + k
        sample: dict[str, Any] = {"timestamp": round(tick * self.T_s, 9), "tick": tick}
        for (group, name), value in zip(_places(rows.role, len(values)), values, strict=True):
            if math.isfinite(value):
                (sample.setdefault(group, {}) if group else sample)[name] = value
        return sample


def block_dtype(role: Role, signals: tuple[str, ...]) -> np.dtype:
    """The dtype of one row of a side that records these columns."""
    times = [(f"{name}_ns", "<i8") for name in TIMES_OF[role]]
    return np.dtype([("tick", "<i8"), *((name, "<f8") for name in signals), *times])


def block_messages(rows: NewRows) -> list[list[bytes]]:
    """The blocks of some rows."""
    columns = recorded_in(rows.role, rows.signals.shape[1])
    whole = np.empty(len(rows.signals), block_dtype(rows.role, columns))
    whole["tick"] = np.arange(rows.first, rows.first + len(whole))
    for j, name in enumerate(columns):
        whole[name] = rows.signals[:, j]
    for j, name in enumerate(TIMES_OF[rows.role]):
        whole[f"{name}_ns"] = rows.times[:, j]
    out = []
    for first in range(0, len(whole), _MOST):
        file = io.BytesIO()
        np.save(file, whole[first : first + _MOST], allow_pickle=False)
        out.append([rows.topic, file.getvalue()])
    return out


@dataclass(frozen=True)
class TickBlock:
    """Rows of one side."""

    role: str  # ``"plant"`` or ``"controller"``
    rows: NDArray[np.void]  # record array, shape (n,); ``rows["tick"]`` shows gaps
    converter: str = ""  # of a network: its name


class BlockReader:
    """Receives blocks; use as a context manager.

    Args:
        endpoint: the endpoint of blocks that ``gfmhil stream`` prints.
        role: ``"plant"`` or ``"controller"``; both if empty.
        converter: of a network, one of its converters; all of them if both are empty.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, role: str = "", converter: str = ""
    ) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, ROOM)
        most = max(block_dtype(role, ALL_COLUMNS.signals(role)).itemsize for role in ROLES)
        self._socket.set(zmq.MAXMSGSIZE, _HEAD + _MOST * most)
        self._socket.subscribe(f"{_topic(converter)}{role}")
        self._socket.connect(endpoint)

    def __enter__(self) -> BlockReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=0)

    def receive(self, timeout_s: float) -> TickBlock | None:
        """The next block, or None on timeout."""
        if not self._socket.poll(round(timeout_s * 1e3)):
            return None
        topic, payload = self._socket.recv_multipart()
        rows = np.load(io.BytesIO(payload), allow_pickle=False)
        converter, _, role = topic.decode().removeprefix(_TOPIC).rpartition("/")
        return TickBlock(role, rows, converter)
