"""Loads for a benchmark: processes on each processor that never sleep, of ordinary priority.

``busy`` computes. The others are those of stress-ng where it is installed, or else ours: copies of
64 MB (memory), writes that reach the disk (files), datagrams to itself (network).
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Literal

Load = Literal["idle", "busy", "memory", "files", "network"]
LOADS: tuple[Load, ...] = ("idle", "busy")
EVERY: tuple[Load, ...] = (*LOADS, "memory", "files", "network")

_BEGIN = (
    "import os, signal, socket, sys, tempfile\n"
    "from gfm_runtime.children import end_with_parent\n"
    # a stopped process takes no other signal
    "end_with_parent(int(sys.argv[2]), signal.SIGKILL)\n"
    "os.sched_setaffinity(0, {int(sys.argv[1])})\n"
    "os.kill(os.getpid(), signal.SIGSTOP)\n"
)
_WORK: dict[Load, str] = {
    "busy": "while True:\n    pass\n",
    "memory": "a, b = bytearray(1 << 26), bytes(1 << 26)\nwhile True:\n    a[:] = b\n",
    "files": (
        "file = tempfile.TemporaryFile()\n"
        "while True:\n"
        "    file.seek(0)\n    file.write(bytes(1 << 22))\n    os.fsync(file.fileno())\n"
    ),
    "network": (
        "end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)\nend.bind(('127.0.0.1', 0))\n"
        "end.connect(end.getsockname())\n"
        "while True:\n    end.send(bytes(1400))\n    end.recv(1400)\n"
    ),
}
#: of stress-ng, per processor
_STRESS: dict[Load, list[str]] = {
    "memory": ["--stream", "1"],
    "files": ["--hdd", "1", "--hdd-bytes", "16M", "--hdd-opts", "sync"],
    "network": ["--udp", "1"],
}
_SETTLE_S = 0.02


def program(kind: Load) -> str:
    """Which program makes a load."""
    return "stress-ng" if kind in _STRESS and shutil.which("stress-ng") else "ours"


@contextmanager
def cpu_load(
    kinds: Sequence[Load] = LOADS,
) -> Iterator[Callable[[Load], AbstractContextManager[None]]]:
    """Start the processes of these loads, stopped; yields a context in which those of one run."""
    started: list[tuple[Load, subprocess.Popen[bytes]]] = []

    def send(wanted: Load, number: signal.Signals) -> None:
        for process in (process for kind, process in started if kind == wanted):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, number)
        if wanted != "idle":
            time.sleep(_SETTLE_S)

    @contextmanager
    def load(wanted: Load) -> Iterator[None]:
        send(wanted, signal.SIGCONT)
        try:
            yield
        finally:
            send(wanted, signal.SIGSTOP)

    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        try:
            for kind in kinds:
                if kind != "idle":
                    cpus = sorted(os.sched_getaffinity(0))
                    started += [(kind, _start(kind, cpu, place)) for cpu in cpus]
            for _, process in started:
                os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
            yield load
        finally:
            for _, process in started:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


def _start(kind: Load, cpu: int, place: str) -> subprocess.Popen[bytes]:
    """A process that stops itself before it works, with a group and session of its own: Ctrl-C is
    the parent's to handle."""
    work = _WORK[kind]
    if program(kind) == "stress-ng":
        line = ["stress-ng", "--quiet", "--temp-path", place, *_STRESS[kind]]
        work = f"os.execvp('stress-ng', {line!r})\n"
    return subprocess.Popen(
        [sys.executable, "-c", _BEGIN + work, str(cpu), str(os.getpid())],
        start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
