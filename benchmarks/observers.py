"""Misses of a run in real time without Modbus clients, and with many that poll without pause.

One run over shared memory with its server beside it. Rounds without a client and with many
alternate in that run, so that other load of the machine disturbs both alike. Before and after the
run both processors only wait for each tick: the ticks that they miss then are the host's.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import select
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.bench.contenders import memory_folder
from gfm_hil.bench.jitter import HYBRID, lost, pace_both, pace_here
from gfm_hil.bench.pair import pair
from gfm_hil.core.terminal import markdown
from gfm_hil.realtime.environment import environment, may_sched_fifo
from gfm_hil.recording.columns import TIMES_OF
from gfm_hil.recording.live import LiveRun
from gfm_hil.run.attribution import CAUSES, attribute

T_S = 1e-4  # s
_SETTLE_S = 0.5  # between two rounds, not counted: clients come and go
_READ = (40070, 125)  # first register and count: most of model 701
_NONE, _MANY = "no client", "clients"
SCENARIO = f"""
title = "observers"
T_s = {T_S}
duration = {{duration}}
mode = "realtime"
law = "vsg-2-tuned"
after_trip = "wait"
[link]
type = "shm"
peer_timeout_s = 30.0
[late_policy]
hold = 1000000000
"""


Timing = dict[str, NDArray[np.int64]]


@dataclass
class Round:
    """One round: begin and end, ns of CLOCK_MONOTONIC, and the replies that clients received."""

    kind: str
    begin: int
    end: int
    answers: int = 0


@dataclass
class Totals:
    """All rounds of one kind together."""

    ticks: int = 0
    missed: list[int] = field(default_factory=list)  # by round
    answers: int = 0
    seconds: float = 0.0
    trips: list[NDArray[np.int64]] = field(default_factory=list)
    causes: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(CAUSES), np.int64))


def poll(pipe: Connection, port: int, clients: int) -> None:
    """In a process of its own: begin or stop polling at each message of the pipe, and answer it."""
    host, request = ("127.0.0.1", port), struct.pack(">HHHBBHH", 0, 0, 6, 1, 3, *_READ)
    whole = 9 + 2 * _READ[1]  # bytes of an answer
    pipe.send("ready")
    while pipe.recv() == "go":
        connections = {
            s.fileno(): s for s in (socket.create_connection(host) for _ in range(clients))
        }
        waits, due, answers = select.epoll(), dict.fromkeys(connections, whole), 0
        for number, connection in connections.items():
            waits.register(number, select.EPOLLIN)
            connection.sendall(request)
        pipe.send("going")
        while not pipe.poll():
            for number, _ in waits.poll(0.1):
                due[number] -= len(connections[number].recv(due[number]))
                if not due[number]:
                    due[number], answers = whole, answers + 1
                    connections[number].sendall(request)
        for connection in connections.values():
            connection.close()
        pipe.recv()
        pipe.send(answers)


def measure(clients: int, seconds: float, rounds: int) -> dict[str, Any]:
    """The rows of the table, as plain data for JSON."""
    policy = "fifo" if may_sched_fifo() else "other"
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        late = [_pace(policy, seconds, rounds)]
        timing, done = _run(Path(place), clients, seconds, rounds)
        late.append(_pace(policy, seconds, rounds))
    totals = {kind: _count(timing, [s for s in done if s.kind == kind]) for kind in (_NONE, _MANY)}
    trip = float(np.median(np.concatenate(totals[_NONE].trips)))
    pieces = [piece for each in late for piece in np.array_split(each, (rounds + 1) // 2, axis=1)]
    missed = [len(lost(piece, T_S * 1e9 - trip)) for piece in pieces]
    ticks = sum(piece.shape[1] for piece in pieces)
    rows = [{"what": "bare pacing", "ticks": ticks, "missed": sum(missed),
             "missed_pct": 100 * sum(missed) / ticks, "by_turn": missed}]  # fmt: skip
    for kind, one in totals.items():
        slack = T_S * 1e6 - np.percentile(np.concatenate(one.trips), (50, 99, 99.9)) * 1e-3
        rows.append({
            "what": kind, "ticks": one.ticks, "missed": sum(one.missed),
            "missed_pct": 100 * sum(one.missed) / one.ticks, "by_turn": one.missed,
            "slack_us": dict(zip(("p50", "p1", "p01"), slack.round(2).tolist(), strict=True)),
            "causes": dict(zip(CAUSES, one.causes.tolist(), strict=True)),
            "answers_per_s": one.answers / one.seconds,
        })  # fmt: skip
    more = np.subtract(totals[_MANY].missed, totals[_NONE].missed)
    return {
        "clients": clients, "seconds": seconds * rounds, "policy": policy, "rows": rows,
        "more_by_turn": more.tolist(), "environment": environment(),
    }  # fmt: skip


def _pace(policy: Any, seconds: float, rounds: int) -> NDArray[np.int64]:
    """Lateness of a loop that only paces, ns, shape (2, ticks), for half the time of the rounds."""
    with ExitStack() as stack:
        two = stack.enter_context(pair(policy, memory_folder(stack)))
        two.both(pace_here, 0, 1, HYBRID, 1)
        return pace_both(two, round(T_S * 1e9), HYBRID, seconds * rounds / 2)


def _run(place: Path, clients: int, seconds: float, rounds: int) -> tuple[Timing, list[Round]]:
    duration = 2 * rounds * (seconds + 2 * _SETTLE_S) + 20.0
    file, folder = place / "observers.toml", place / "run"
    file.write_text(SCENARIO.format(duration=duration), encoding="utf-8")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "gfm_hil", "run", str(file), "--out", str(folder)]
    command += ["--quiet", "--no-figures", "--modbus", str(port)]
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    pollers = multiprocessing.get_context("spawn").Process(
        target=poll, args=(theirs, port, clients), daemon=True
    )
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert run.stderr is not None
        while "Modbus" not in (line := run.stderr.readline()):
            if not line:
                raise SystemExit("the run did not start")
        pollers.start()
        theirs.close()  # else we wait for ever for one that has failed
        ours.recv()
        done = []
        for round_ in range(rounds):
            for kind in (_NONE, _MANY)[:: -1 if round_ % 2 else 1]:
                done.append(_round(kind, seconds, ours))
        timing = _times(folder)
    finally:
        run.terminate()
        run.communicate()
        if pollers.is_alive():
            pollers.kill()
    return timing, done


def _times(folder: Path) -> Timing:
    """What both sides have recorded so far, as in timing.npz."""
    run = LiveRun(folder)
    done = min(run.done(role) for role in run.parts)
    return {
        f"{role}_{name}": np.array(run.columns[f"{role}_{name}"][:done])
        for role in run.parts
        for name in TIMES_OF[role]
    }


def _round(kind: str, seconds: float, pipe: Any) -> Round:
    if kind == _MANY:
        pipe.send("go")
        pipe.recv()
    time.sleep(_SETTLE_S)
    begin = time.monotonic_ns()
    time.sleep(seconds)
    round_ = Round(kind, begin, time.monotonic_ns())
    if kind == _MANY:
        pipe.send("stop")
        round_.answers = pipe.recv()
    time.sleep(_SETTLE_S)
    return round_


def _count(timing: Timing, done: list[Round]) -> Totals:
    totals = Totals()
    for round_ in done:
        scheduled = timing["plant_scheduled"]
        here = (scheduled >= round_.begin) & (scheduled < round_.end)
        part = {name: column[here] for name, column in timing.items()}
        received = part["plant_received"] >= 0
        totals.ticks += len(received)
        totals.missed.append(int((~received).sum()))
        totals.trips.append((part["plant_received"] - part["plant_scheduled"])[received])
        causes = attribute(part, round(T_S * 1e9)).causes
        totals.causes += np.bincount(causes, minlength=len(CAUSES))
        totals.answers += round_.answers
        totals.seconds += (round_.end - round_.begin) * 1e-9
    return totals


def _table(result: dict[str, Any]) -> str:
    """The rows side by side, as a table of Markdown."""
    kinds = result["rows"]
    lines: list[list[str]] = []

    def line(name: str, cells: list[str]) -> None:
        lines.append([name, *cells])

    line("ticks", [f"{row['ticks']}" for row in kinds])
    line("ticks missed", [f"{row['missed']}" for row in kinds])
    line("%", [f"{row['missed_pct']:.4f}" for row in kinds])
    line("in the median round", [f"{statistics.median(row['by_turn']):g}" for row in kinds])
    line("round by round", [", ".join(map(str, row["by_turn"])) for row in kinds])
    for name, words in (("p50", "50"), ("p1", "99"), ("p01", "99.9")):
        cells = [f"{row['slack_us'][name]:g}" if "slack_us" in row else "–" for row in kinds]
        line(f"slack that {words} % have, µs", cells)
    for cause in CAUSES:
        cells = [str(row["causes"][cause]) if "causes" in row else "–" for row in kinds]
        line(f"missed for {cause}", cells)
    cells = [f"{row['answers_per_s']:.0f}" if row.get("answers_per_s") else "–" for row in kinds]
    line("answers a second", cells)
    by_turn = result["more_by_turn"]
    more = ", ".join(f"{each:+d}" for each in by_turn)
    error = np.std(by_turn, ddof=1) / len(by_turn) ** 0.5 if len(by_turn) > 1 else math.nan
    return "\n".join([
        markdown(["", *(row["what"] for row in kinds)], lines), "",
        f"{result['clients']} clients for {result['seconds']:g} s, {result['policy']}: "
        f"{np.mean(by_turn):+.0f} ± {error:.0f} misses in a round (mean and its standard error); "
        f"round by round {more}",
    ])  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clients", type=int, default=50, help="(default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of a round (%(default)s)")
    parser.add_argument("--rounds", type=int, default=6, help="of each kind (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON and nothing else")
    options = parser.parse_args()
    if options.clients < 1 or options.rounds < 1 or not 0.1 <= options.seconds <= 3600:
        parser.error("--clients and --rounds must be at least 1, --seconds in [0.1, 3600]")
    result = measure(options.clients, options.seconds, options.rounds)
    print(json.dumps(result, indent=1) if options.json else _table(result))


if __name__ == "__main__":
    main()
