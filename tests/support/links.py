"""Links to test, and both sides of a run in two threads of this process."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.drive import Share, run_loop
from gfm_hil.engine.handshake import shake_hands
from gfm_hil.engine.process import compile_role
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.links import Link, link_kind, open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.impaired.link import ImpairedLink
from gfm_hil.links.serial.line import COUNT_DAMAGED, feed, make_line, take
from gfm_hil.recording.log import read_log
from gfm_hil.recording.merge import merge
from gfm_hil.recording.parts import RolePart
from gfm_hil.recording.run import read_recording
from gfm_hil.scenario import Scenario

PATIENT = {"type": "inproc", "peer_timeout_s": 30.0, "start_timeout_s": 60.0}


RIG = {
    "delay": {"samples": 1, "fraction": 0.3},
    "adc": "DS2004",
    "dac": "DS2101",
    "sensors": {"bandwidth_hz": 2000.0, "noise_std": {"p": 1e-4, "V": 1e-4}},
}


PORTS = ("shm", "zmq")  # links that the loops drive without a thread of Python


def in_threads(call: Callable[[Role], Any]) -> dict[Role, Any]:
    """The same call for both sides at once; returns each side's result or exception."""
    found: dict[Role, Any] = {}

    def one(role: Role) -> None:
        try:
            found[role] = call(role)
        except Exception as problem:
            found[role] = problem

    threads = [threading.Thread(target=one, args=(role,), daemon=True) for role in ROLES]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def assert_same(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """Check that both are equal bit by bit, NaN included."""
    assert set(one) == set(other)
    for name in one:
        assert one[name].tobytes() == other[name].tobytes(), name


LINKS: dict[str, tuple[str, dict[str, Any]]] = {
    "shm": ("shm", {}),
    "zmq": ("zmq", {}),
    "zmq-portable": ("zmq", {"portable": True}),
    "can": ("can", {}),
}


def deliver(link: Link, message: bytes) -> None:
    """Send a message as soon as there is room."""
    while not link.send(message):
        time.sleep(0.001)


class Tampering:
    """A link that passes outgoing messages through ``change``; None drops one.

    It has no port, so that every message passes through ``send``.
    """

    port = None

    def __init__(self, link: Link, change: Callable[[int, bytes], bytes | None]) -> None:
        self._link, self._change, self._count = link, change, 0

    def send(self, message: bytes) -> bool:
        changed = self._change(self._count, message)
        self._count += 1
        return changed is None or self._link.send(changed)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._link, name)


Touch = Callable[[Role, Link], Link]


class Unstuffer:
    """Takes bytes as they come from a serial line, and gives whole messages, as the compiled link
    does.

    Attributes:
        damaged: what stood between two zeros and was no message.
    """

    def __init__(self) -> None:
        self._line, self._message = make_line(), np.zeros(LONGEST, np.uint8)
        self._found: list[bytes] = []

    @property
    def damaged(self) -> int:
        return int(self._line[COUNT_DAMAGED])

    def feed(self, came: bytes) -> None:
        for begin in range(0, len(came), 4096):
            feed(self._line, came[begin : begin + 4096])
            while size := take(self._line, self._message):
                self._found.append(self._message[:size].tobytes())

    def next(self) -> bytes | None:
        return self._found.pop(0) if self._found else None

    def all(self) -> list[bytes]:
        found, self._found = self._found, []
        return found


@dataclass
class Pair:
    """The results of a run in two threads."""

    # signals, timing: as in signals.npz and timing.npz
    signals: dict[str, np.ndarray] = field(default_factory=dict)
    timing: dict[str, np.ndarray] = field(default_factory=dict)
    # each side's counters of frames
    faults: dict[Role, dict[str, int]] = field(default_factory=dict)
    # counters of each side's impairment stage
    injected: dict[Role, dict[str, int]] = field(default_factory=dict)
    # each side's, of a link that carries a message in several frames
    counters: dict[Role, dict[str, int]] = field(default_factory=dict)
    log: list[dict[str, Any]] = field(default_factory=list)  # lines of both event logs

    def ends(self) -> dict[str, tuple[str, str, int]]:
        """How each side ended: status, reason, tick."""
        return {
            e["role"]: (e["status"], e["reason"], e["tick"])
            for e in self.log
            if e["event"] == "end"
        }


def run_pair(
    scenario: Scenario,
    folder: Path,
    link: str,
    options: dict[str, Any] | None = None,
    touch: Touch = lambda role, link: link,
    stopped: Callable[[], bool] = lambda: False,
    endpoint: str | dict[Role, str] | None = None,
) -> Pair:
    """Run a scenario over a link, new if there is no ``endpoint``, one or one a side; ``touch`` may
    wrap an end after the handshake."""
    folder.mkdir(parents=True, exist_ok=True)
    where = endpoint or link_kind(link).fresh(folder)
    wheres = where if isinstance(where, dict) else dict.fromkeys(ROLES, where)
    benches = {role: make_bench(scenario) for role in ROLES}
    parts = {
        role: RolePart.create(folder, role, scenario.ticks, benches[role].columns) for role in ROLES
    }
    for role in ROLES:
        compile_role(role, [benches[role]], [parts[role]])
    pair = Pair()

    def call(role: Role) -> None:
        bench, part, impairment = benches[role], parts[role], scenario.link.impairment
        end = open_link(link, role, wheres[role], options, bench.signal_set)
        timeline = Timeline(bench, folder / f"events_{role}.jsonl", (role,))
        used = end
        if impairment is not None and impairment.hits(role):
            used = ImpairedLink(end, impairment, role)  # compiles: before START
        try:
            t0 = shake_hands(role, end, scenario, lambda: False, lambda text: None).t0_ns
            share = Share(bench, touch(role, used), part, timeline)
            (reader,) = run_loop(role, [share], t0, stopped)
            pair.faults[role] = dict(reader.faults)
            pair.counters[role] = dict(getattr(end, "counters", {}))
            if isinstance(used, ImpairedLink):
                pair.injected[role] = used.injected
        finally:
            end.close()
            timeline.close()

    for problem in in_threads(call).values():
        if problem is not None:
            raise problem
    pair.log = read_log(*sorted(folder.glob("events_*.jsonl")))
    merge(folder, scenario.T_s, benches["controller"].controller.labels)
    pair.signals = {name: x[:] for name, x in read_recording(folder)[0].items()}
    with np.load(folder / "timing.npz") as file:
        pair.timing = dict(file)
    return pair
