"""Stalls that a test provokes get the right name; what is named is never the link's."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from gfm_hil.realtime.environment import may_sched_fifo
from gfm_hil.run.attribution import CAUSES, attribute, missed_ticks
from gfm_hil.run.kernel_trace import tracefs
from gfm_hil.run.proc_watch import ProcWatch
from gfm_hil.run.processor_time import STOPPED, UNREAD, nobody
from gfm_hil.run.runner import run_scenario
from gfm_hil.run.stalls import ProcessorWatch, loops_of
from gfm_hil.scenario import check_scenario

pytestmark = [pytest.mark.processes, pytest.mark.alone]

T_NS = 100_000
#: by method, how many stalls and the least pause between them, s: /proc is read every 0.1 s
STALLS = {"trace": (60, 0.08), "proc": (60, 0.3)}
NAMES = {"fifo": "thread stall-fifo", "busy": "thread stall-busy", "stop": STOPPED}
#: provokes stalls of 2 to 5 ms of threads in turn, and prints (kind, begin, end) of each
PROVOKE = """
import json, os, signal, sys, time
n, pause, done = int(sys.argv[1]), float(sys.argv[2]), []
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))  # its sleeps take no processor
loops = json.loads(sys.stdin.readline())
for k in range(n):
    cpu, thread = list(loops.items())[k % len(loops)]
    kind = ("fifo", "busy", "stop")[k % 3]
    time.sleep(pause / 2)  # then the reading that saw the last stall is over
    open("/proc/self/comm", "w").write("stall-" + kind)
    time.sleep(pause / 2 + 0.0137 * (k % 7))
    os.sched_setaffinity(0, set(range(os.cpu_count())) if kind == "stop" else {int(cpu)})
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(80 if kind == "fifo" else 60))
    begin = time.monotonic_ns()
    if kind == "stop":
        os.kill(thread, signal.SIGSTOP)
        time.sleep(0.002)
        os.kill(thread, signal.SIGCONT)
    while kind != "stop" and time.monotonic_ns() < begin + (2 if kind == "fifo" else 5) * 10**6:
        pass
    done.append((kind, begin, time.monotonic_ns()))
print(json.dumps(done))
"""


@pytest.fixture
def trace(tmp_path_factory):
    """The kernel's trace; it mounts tracefs if need be."""
    if os.geteuid() or not may_sched_fifo():
        pytest.skip("needs root, and the right to SCHED_FIFO")
    mounted = None
    if isinstance(tracefs(), str):
        place = tmp_path_factory.mktemp("tracefs")
        if subprocess.run(["mount", "-t", "tracefs", "nodev", str(place)], check=False).returncode:
            pytest.skip("this kernel has no tracefs")
        mounted = place
    yield
    if mounted:
        subprocess.run(["umount", "--lazy", str(mounted)], check=True)


def provoked(tmp_path: Path, stalls_wanted: int, pause_s: float):
    """A run in real time with stalls; (kind, names of its missed ticks, their causes) of each."""
    content = {
        "title": "stalls", "duration": 100.0, "T_s": 1e-4,
        "mode": "realtime",
        "law": "mimo-gfm", "link": {"type": "shm", "peer_timeout_s": 5.0},
        "late_policy": {"hold": 10**9},
    }  # fmt: skip
    folder = tmp_path / "run"
    command = [sys.executable, "-c", PROVOKE, str(stalls_wanted), str(pause_s)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as child, ProcessorWatch() as watch:
        ended = False

        def progress(ticks, misses):
            nonlocal ended
            if ticks > 5_000 and not watch.loops:
                watch.begin(loops_of(folder))
                print(json.dumps(watch.loops), file=child.stdin, flush=True)
            if not ended and child.poll() is not None:
                ended = True
                os.kill(os.getpid(), signal.SIGINT)

        run = run_scenario(check_scenario(content, "test"), folder, progress)
        made = json.loads(child.communicate(timeout=60)[0])
    assert run.status == "interrupted"
    timing = {name: np.array(column[:]) for name, column in run.timing.items()}
    why = attribute(timing, T_NS, (), watch.taken, [*watch.loops])
    at = timing["plant_scheduled"][missed_ticks(timing)]
    for kind, begin, end in made:
        here = np.flatnonzero((at >= begin - T_NS) & (at <= end))
        yield kind, [why.names[k] for k in here], {CAUSES[why.causes[k]] for k in here}


def test_the_trace_names_95_of_100_provoked_stalls(tmp_path, trace):
    wanted, pause_s = STALLS["trace"]
    right, wrong = 0, Counter[tuple[str, str]]()
    for kind, names, causes in provoked(tmp_path, wanted, pause_s):
        assert "link" not in causes
        named = Counter(names).most_common(1)[0][0] if names else "no miss"
        if named.startswith(NAMES[kind]):
            right += 1
        elif named != UNREAD:
            wrong[kind, named] += 1
    assert right > wanted / 2
    assert wrong.total() <= 0.05 * wanted, wrong


def test_proc_blames_no_thread_that_did_not_run(tmp_path, monkeypatch):
    """/proc does not show a stop of 2 ms between two readings, nor always who ran while it is
    read, and on a busy machine the host takes its part: how many have a name is not judged."""
    if not may_sched_fifo():
        pytest.skip("needs the right to SCHED_FIFO")
    monkeypatch.setattr("gfm_hil.run.stalls.tracefs", lambda: "no trace")
    wanted, pause_s = STALLS["proc"]
    right, blamed = 0, Counter[tuple[str, str]]()
    for kind, names, causes in provoked(tmp_path, wanted, pause_s):
        assert "link" not in causes
        right += any(name.startswith(NAMES[kind]) for name in names)
        blamed.update((kind, name) for name in {*names} if name.startswith("thread "))
    others = {one: n for one, n in blamed.items() if not one[1].startswith("thread stall-")}
    assert sum(others.values()) <= 0.05 * wanted, others
    assert right


def test_proc_shows_the_thread_that_a_loop_waited_for():
    """Two threads of equal priority on one processor: each waits for the other."""
    spin = [sys.executable, "-c", "open('/proc/self/comm', 'w').write('rival')\nwhile True: pass"]
    loop, rival = (subprocess.Popen(spin, stdin=subprocess.DEVNULL) for _ in range(2))
    try:
        cpu = min(os.sched_getaffinity(0))
        for process in (loop, rival):
            os.sched_setaffinity(process.pid, {cpu})
        time.sleep(0.2)
        watch = ProcWatch({cpu: loop.pid}, "no trace")
        time.sleep(1.0)
        loop.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        taken = watch.stop()
    finally:
        for process in (loop, rival):
            process.kill()
            process.wait()
    names = [name for name, *_ in taken.totals()]
    assert any(name.startswith("thread ") for name in names)
    assert STOPPED in names
    assert (taken.method, taken.why) == ("proc", "no trace")
    begin, end = int(taken.rows["begin"].min()), int(taken.rows["end"].max())
    assert taken.who(begin, end, 1.0, [cpu]) in names
    assert taken.who(begin, end, 1e12, [cpu]) == nobody("proc")


def test_nothing_of_the_trace_is_left_after_a_kill(trace):
    program = (
        "import os, signal; from gfm_hil.run.kernel_trace import KernelTrace, tracefs\n"
        "KernelTrace(tracefs(), {0: -1}, 0); os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.Popen([sys.executable, "-c", program])
    assert killed.wait() == -signal.SIGKILL
    deadline = time.monotonic() + 10
    while left := list((tracefs() / "instances").glob(f"gfmhil-{killed.pid}-*")):
        assert time.monotonic() < deadline, left
        time.sleep(0.05)
