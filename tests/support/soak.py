"""The soak test's measurements of each process, and its clients that connect and disconnect."""

import contextlib
import csv
import itertools
import json
import socket
import struct
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from pymodbus.client import ModbusTcpClient
from websockets.sync.client import connect

from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.image import BASE, VENDOR, Image
from gfm_hil.ports.streams import BlockReader

MB = 1e6
SETTLE_S = 15.0  # how long a process may take to free the resources of former clients
PATIENCE_S = 200.0  # timeout of an answer, on a crowded machine
_LOOK = {
    "kind": "look", "id": 1, "channels": ["p", "q"], "bins": 64, "mode": "roll", "span": 1.0,
}  # fmt: skip


@dataclass(frozen=True)
class Sample:
    """One process at one moment."""

    t: float  # since the start, s
    own: int  # private memory of the process (RssAnon), bytes
    pss: int  # private memory and its share of shared memory, mainly the recording, bytes
    # descriptors, threads: their numbers
    descriptors: int
    threads: int


def take_sample(pid: int, t: float) -> Sample:
    """Read a process's figures from /proc. Raises OSError: the process is gone."""
    process = Path(f"/proc/{pid}")
    status = dict(
        line.split(":", 1) for line in (process / "status").read_text().splitlines() if ":" in line
    )
    rollup = (process / "smaps_rollup").read_text()
    pss = next(line for line in rollup.splitlines() if line.startswith("Pss:"))
    return Sample(
        t,
        int(status["RssAnon"].split()[0]) * 1024,
        int(pss.split()[1]) * 1024,
        len(list((process / "fd").iterdir())),
        int(status["Threads"]),
    )


@dataclass
class Sampler:
    """The samples of several processes, taken while no client is connected.

    Args:
        pids: process number by name.
    """

    pids: dict[str, int]
    begin: float = field(default_factory=time.monotonic)
    samples: dict[str, list[Sample]] = field(default_factory=dict)

    def take(self) -> None:
        """Take a sample of each, once they have freed the resources of the last round's clients.

        The fewest descriptors and threads of several readings count: a server opens the recording
        anew whenever it reads it, and closes it again.
        """
        until = time.monotonic() + SETTLE_S
        now = self._read()
        while not self._settled(now) and time.monotonic() < until:
            time.sleep(0.2)
            now = {
                name: replace(
                    one,
                    descriptors=min(one.descriptors, now[name].descriptors),
                    threads=min(one.threads, now[name].threads),
                )
                for name, one in self._read().items()
            }
        for name, one in now.items():
            self.samples.setdefault(name, []).append(one)

    def _read(self) -> dict[str, Sample]:
        return {n: take_sample(p, time.monotonic() - self.begin) for n, p in self.pids.items()}

    def _settled(self, now: dict[str, Sample]) -> bool:
        return all(
            one.descriptors <= self.samples[name][-1].descriptors
            and one.threads <= self.samples[name][-1].threads
            for name, one in now.items()
            if name in self.samples
        )

    def column(self, name: str, what: str) -> np.ndarray:
        """One figure of one process over all samples."""
        return np.array([getattr(sample, what) for sample in self.samples[name]], float)

    def rise(self, name: str, first: int) -> float:
        """Growth of a process's own memory from sample ``first`` on, by a fitted line, bytes."""
        t, own = self.column(name, "t")[first:], self.column(name, "own")[first:]
        return float(np.polyfit(t - t[0], own, 1)[0] * (t[-1] - t[0]))

    def table(self, first: int) -> list[str]:
        """One line per process."""
        head = ("process", "own MB: first", "last", "most", "rise", "Pss MB", "descr.", "threads")
        lines = ["".join(f"{word:>14}" for word in head)]
        for name in self.samples:
            own, pss = self.column(name, "own")[first:] / MB, self.column(name, "pss")[-1] / MB
            numbers = (own[0], own[-1], own.max(), self.rise(name, first) / MB, pss)
            counts = [
                f"{self.column(name, what)[first]:.0f}-{self.column(name, what)[first:].max():.0f}"
                for what in ("descriptors", "threads")
            ]
            words = [name, *(f"{number:.2f}" for number in numbers), *counts]
            lines.append("".join(f"{word:>14}" for word in words))
        return lines

    def write_csv(self, path: Path) -> None:
        """Write one line per sample."""
        with path.open("w", encoding="utf-8", newline="") as file:
            out = csv.writer(file)
            out.writerow(["process", "t_s", "own_bytes", "pss_bytes", "descriptors", "threads"])
            for name, samples in self.samples.items():
                out.writerows(
                    [name, f"{s.t:.3f}", s.own, s.pss, s.descriptors, s.threads] for s in samples
                )


@dataclass
class Clients:
    """All kinds of clients of a run; in one ``round`` each connects and disconnects.

    Args:
        folder: of the run.
        scope: the address to look at, with a slash at its end.
        token: to control.
        modbus, samples, blocks, metrics: ports.
        image: of the Modbus registers, for their addresses.
    """

    folder: Path
    scope: str
    token: str
    modbus: int
    samples: int
    blocks: int
    metrics: int
    image: Image
    rounds: int = 0

    def round(self) -> None:
        """Every client connects, does something, and disconnects."""
        k = self.rounds
        self.rounds += 1
        self._pages(k)
        self._modbus_clients(k)
        self._listeners()
        self._operator(k)
        self._strangers()

    def _pages(self, k: int) -> None:
        address = self.scope.replace("http", "ws", 1) + "socket"
        with connect(address) as one, connect(address) as other:
            for page in (one, other):
                page.send(json.dumps(_LOOK))
            one.send(json.dumps({"kind": "hello", "token": self.token}))
            event = {"type": "reference", "P_ref": 0.4 + 0.02 * (k % 5), "ramp_s": 0.05}
            one.send(json.dumps({"kind": "command", "id": k, "event": event}))
            answer = _until(one.recv, lambda m: isinstance(m, str) and '"answer"' in m)
            assert json.loads(answer)["ok"] or "SAFE" in answer, answer
            for _ in range(5):
                _until(other.recv, lambda m: isinstance(m, bytes))

    def _modbus_clients(self, k: int) -> None:
        with contextlib.closing(
            ModbusTcpClient("127.0.0.1", port=self.modbus, timeout=PATIENCE_S)
        ) as one:
            assert one.connect()
            suns = one.read_holding_registers(BASE, count=2).registers
            assert struct.pack(">2H", *suns) == b"SunS"
            for path, value in (("715.ControllerHb", k), (f"{VENDOR}.Law", 1 + k % 2)):
                point = self.image.points[path]
                assert not one.write_registers(point.address, point.encode(value)).isError()
            assert one.write_registers(BASE, [0]).isError()  # refused, but not for ever

    def _listeners(self) -> None:
        with zmq.Context() as context, context.socket(zmq.SUB) as juggler:
            juggler.set(zmq.LINGER, 0)
            juggler.subscribe(b"")
            juggler.connect(f"tcp://127.0.0.1:{self.samples}")
            assert juggler.poll(PATIENCE_S * 1e3), "no sample came"
        with BlockReader(f"tcp://127.0.0.1:{self.blocks}") as reader:
            assert reader.receive(PATIENCE_S) is not None, "no block came"
        with urllib.request.urlopen(
            f"http://127.0.0.1:{self.metrics}/metrics", timeout=PATIENCE_S
        ) as page:
            assert b"gfmhil_ticks_total" in page.read()

    def _operator(self, k: int) -> None:
        operator = Operator(self.folder)
        try:
            operator.command({"type": "law", "law": "droop-5"})
            operator.command({"type": "gains", "values": {"D_p": 0.01 + 1e-5 * (k % 7)}})
            operator.command({"type": "grid-frequency", "f_hz": 50.0 + 0.01 * (k % 2), "rate": 1.0})
            if k % 3 == 2:  # a trip, and back to the start
                operator.command({"type": "grid-voltage", "V_g": 0.0})
                _until(operator.snapshot, lambda seen: seen["state"] == "SAFE")
                operator.command({"type": "reset"})
                _until(operator.snapshot, lambda seen: seen["state"] == "RUNNING")
        finally:
            operator.close()
        command = [sys.executable, "-m", "gfm_hil", "command", str(self.folder), "Q_ref=0.0"]
        told = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )
        assert told.returncode == 0, told.stderr

    def _strangers(self) -> None:
        """Connections that send garbage and are closed."""
        web = int(self.scope.rpartition(":")[2].strip("/"))
        for port, said in itertools.product(
            (web, self.modbus, self.samples, self.blocks, self.metrics), (b"", b"\xff" * 40)
        ):
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as stranger:
                stranger.sendall(said)
                gone = struct.pack("ii", 1, 0)  # reset instead of an orderly end
                stranger.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, gone)


def _until(take: Callable[[], Any], wanted: Callable[[Any], bool]) -> Any:
    """Call ``take`` until its result is the wanted one."""
    until = time.monotonic() + PATIENCE_S
    while not wanted(found := take()):
        assert time.monotonic() < until, "the condition did not come true in time"
        time.sleep(0.002)
    return found


def ports_in(lines: Iterable[str], count: int) -> list[int]:
    """The last number of each of the first ``count`` lines: the ports of the addresses."""
    found = (line.split()[1].removesuffix("/metrics").rpartition(":")[2] for line in lines)
    return [int(port) for port in itertools.islice(found, count)]
