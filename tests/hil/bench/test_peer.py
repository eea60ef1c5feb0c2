"""``gfmhil bench latency --to``: who answers elsewhere. The tests judge no time."""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest
from scipy.stats import binomtest

from gfm_hil.bench.contenders import free_port
from gfm_hil.bench.peer import scenario_of
from gfm_hil.cli import main
from gfm_hil.scenario import write_scenario
from gfm_runtime.children import guarded

from .test_bench import alone, bench, processes_with

pytestmark = pytest.mark.processes

GFMHIL = [sys.executable, "-m", "gfm_hil"]
SHORT = ("--seconds", "0.05", "--load", "idle", "--policy", "other")  # beside other tests
OWN = Path(__file__).parents[3] / "examples" / "own_controller" / "controller.py"


@contextlib.contextmanager
def other_side(*line):
    """A program that answers, and ends with this one, even if this one is killed."""
    with subprocess.Popen(
        guarded(line), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


@pytest.mark.parametrize(
    ("link", "modes"),
    [
        *[(link, "lockstep") for link in ("tcp", "shm", "pty")],
        # in real time, beside another test, all answers may be late
        *[pytest.param(link, "lockstep,realtime", marks=alone) for link in ("udp", "can")],
    ],
)
def test_both_ways_over_every_link(link, modes, tmp_path, capsys):
    place, port = uuid.uuid4().hex, free_port()
    endpoint = {
        "shm": f"shm://{place}", "pty": f"pty://{tmp_path}/line", "can": "can+udp://127.0.0.1:"
        f"{20000 + port % 20000}",
    }.get(link, f"{link}://127.0.0.1:{port}")  # fmt: skip
    with other_side(*GFMHIL, "bench", "answer", endpoint):
        line = ("latency", "--to", endpoint, "--as", "far", "--rounds", "1", *SHORT)
        rows = bench(tmp_path, capsys, *line, "--mode", modes)
    rows = [row for row in rows["results"] if row["peer"] == "to"]
    assert [row["mode"] for row in rows] == modes.split(",")
    for row in rows:
        assert row["name"] == "far" and row["n"] == row["sent"] - row["lost"] > 0
        assert 0 < row["bench_us"] < row["p50_us"]
        if link == "can":  # its frames have no room for a clock
            assert "clock" not in row
            continue
        assert (row["clock"], row["within_us"]) == ("one clock", 0.0)
        assert 0 < row["there"]["p50_us"] + row["back"]["p50_us"] < row["max_us"]
        assert row["between"]["n"] == row["n"]


_RELAY = """
import heapq, random, select, socket, sys, time
port, to = int(sys.argv[1]), int(sys.argv[2])
near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
near.bind(("127.0.0.1", port)); far.connect(("127.0.0.1", to))
draw, waiting, home = random.Random(1), [], None
while True:
    wait = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 0.5
    for source in select.select([near, far], [], [], wait)[0]:
        try:
            message, sender = source.recvfrom(1000)
        except OSError:
            continue
        now, there = time.monotonic(), source is near
        home = sender if there else home
        if len(message) == 64 and draw.random() < 0.01:
            continue
        late = (1e-3 if there else 2e-4) + draw.random() * 5e-5
        heapq.heappush(waiting, (now + late, draw.random(), there, message))
    while waiting and waiting[0][0] <= time.monotonic():
        *_, there, message = heapq.heappop(waiting)
        try:
            far.send(message) if there else near.sendto(message, home)
        except OSError:
            pass
"""


def test_ways_that_differ_through_a_relay(tmp_path, capsys):
    """1 ms there and 0.2 ms back, 0.05 ms of jitter, 1 % lost."""
    near, far = free_port(), free_port()
    with (
        other_side(sys.executable, "-c", _RELAY, str(near), str(far)),
        other_side(*GFMHIL, "bench", "answer", f"udp://127.0.0.1:{far}"),
    ):
        found = bench(
            tmp_path, capsys, "latency", "--to", f"udp://127.0.0.1:{near}", "--mode", "lockstep",
            "--load", "idle", "--policy", "other", "--seconds", "0.5",
        )  # fmt: skip
    (row,) = [row for row in found["results"] if row["peer"] == "to"]
    assert row["clock"] == "one clock"
    assert row["there"]["p50_us"] >= 1000 and row["back"]["p50_us"] >= 200
    losses = binomtest(row["lost"], row["sent"], 0.01)
    assert losses.pvalue > 1e-4  # which of the relay's draws are lost depends on the machine
    exact = losses.proportion_ci(0.95, "exact")
    assert row["lost_pct_95"] == pytest.approx([100 * exact.low, 100 * exact.high], abs=1e-3)


def test_a_program_of_docs_own_controller(tmp_path, capsys):
    endpoint = f"ipc://{tmp_path}/own"
    write_scenario(tmp_path, scenario_of())
    program = [sys.executable, str(OWN), endpoint, str(tmp_path / "scenario.toml")]
    again = f"until {shlex.join(program)}; do :; done"  # it waits for 20 s at a time
    with other_side("sh", "-c", again) as process:
        found = bench(tmp_path, capsys, "latency", "--to", endpoint, "--mode", "lockstep", *SHORT)
        assert process.wait(30) == 0, process.stderr.read()  # we say goodbye
    (row,) = [row for row in found["results"] if row["peer"] == "to"]
    assert row["n"] == row["sent"] - row["lost"] > 0 and "clock" not in row


@pytest.mark.apt
def test_a_controller_that_the_bench_starts(tmp_path, capsys):
    assert main(["firmware", "dll", "vsg-2", "--out", str(tmp_path / "law")]) == 0
    capsys.readouterr()
    (file,) = (tmp_path / "law").rglob("*.so")
    options = ("--to", f"dll:{file}", "--as", "vsg-2", "--mode", "lockstep", *SHORT)
    (row,) = (
        row
        for row in bench(tmp_path, capsys, "latency", *options)["results"]
        if row["peer"] == "to"
    )
    assert row["name"] == "vsg-2" and row["n"] == row["sent"] - row["lost"] > 0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (["--to", "foo://x"], "foo://x: must be "),
        (["--to", "tcp://no-host.invalid:5", "--option", "plain=true"], "no route: "),
        (["--to", "tcp://192.0.2.1:5"], "goes beyond this machine, unencrypted"),
        (["--to", "tcp://127.0.0.1:5", "--ptp", "1"], "--ptp 1: "),
        (["--to", "tcp://127.0.0.1:5", "--map", "m.toml"], "--map m.toml: is for a controller"),
        (["--to", "dll:none.so"], "none.so: there is no such file"),
        (["--to", "udp://127.0.0.1:5", "--option", "x=1"], "options.x = 1: unknown key"),
    ],
)
def test_wrong_peers_are_refused_in_a_line(line, said, tmp_path, capsys):
    assert main(["bench", "latency", *line, "--out", str(tmp_path / "none")]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not (tmp_path / "none").exists()


def test_another_version_is_refused_by_both_sides(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")  # also where there are no limits
    endpoint = f"tcp://127.0.0.1:{free_port()}"
    other = (
        "import sys, gfm_hil.engine.handshake as h\n"
        "h.TABLE_VERSION += 1\n"
        "from gfm_hil.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    with other_side(sys.executable, "-c", other, "bench", "answer", endpoint) as process:
        line = ["bench", "latency", "--to", endpoint, "--out", str(tmp_path / "none")]
        assert main(line) == 2
        process.send_signal(signal.SIGINT)
        answerer = process.communicate(timeout=60)[1].decode()
    assert "runs another version of the signal table" in capsys.readouterr().err
    assert "the plant runs another version of the signal table" in answerer


@alone  # another test may leave something in /dev/shm meanwhile
@pytest.mark.timeout(500)
def test_killed_benchmarks_leave_nothing_behind(tmp_path):
    """No process, no memory segment, no folder; what removes their folders waits for 10 s."""
    shm = Path("/dev/shm")
    before = {*shm.rglob("*"), shm / f"gfmhil-{os.geteuid()}"}
    lines = {
        f"GFMHIL_TEST={uuid.uuid4()}": line
        for line in (
            ["latency", "--links", "shm,zmq", "--peers", "none"],
            ["loop", "--links", "shm", "--laws", "vsg-2"],
        )
    }
    for mark, line in lines.items():
        with subprocess.Popen(
            [*GFMHIL, "bench", *line, "--seconds", "8", "--out", str(tmp_path / line[0])],
            env={**os.environ, **dict([mark.split("=")])},
        ) as process:
            try:
                until = time.monotonic() + 200  # it may have to compile
                while processes_with(mark) < 4 + len(os.sched_getaffinity(0)):
                    assert process.poll() is None and time.monotonic() < until
                    time.sleep(0.2)
                time.sleep(1)
            finally:
                process.kill()
    until = time.monotonic() + 60
    left: set[Path] = set()
    while time.monotonic() < until:
        left = {path for path in {*shm.rglob("*")} - before if "gfmhil" in str(path)}
        if not any(map(processes_with, lines)) and not left:
            return
        time.sleep(0.2)
    pytest.fail(f"{[*map(processes_with, lines)]} processes, {left}")
