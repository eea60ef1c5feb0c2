"""SocketCAN for real, in a kernel that has it: user-mode Linux, booted on the host's files.

Debian's packages ``user-mode-linux``, ``kmod`` and ``iproute2``. The kernel is a process of the
user, but the tests inside write to the host's files, so they want to be asked for: GFMHIL_UML=1.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
INIT = HERE.parent / "uml" / "init.sh"

pytestmark = [pytest.mark.apt, pytest.mark.uml]


@pytest.mark.skipif(
    "GFMHIL_UML" not in os.environ, reason="boots a kernel; GFMHIL_UML=1 asks for it"
)
@pytest.mark.timeout(1200)
def test_socketcan_inside_user_mode_linux(tmp_path):
    job, status, log = (tmp_path / name for name in ("job.sh", "status", "log"))
    # hostfs cuts times of files to seconds, so that a cache of compiled code shared with the host
    # would be thrown away by the one and then by the other
    settings = {
        **{name: os.environ[name] for name in ("PATH", "PYTHONPATH") if name in os.environ},
        "HOME": str(tmp_path),
        "TMPDIR": "/dev/shm",  # in the host's, what belongs to no process of the host is tidied up
        "NUMBA_CACHE_DIR": str(HERE.parents[1] / ".pytest_cache" / "uml"),
        "MPLBACKEND": "Agg",
        "OPENBLAS_NUM_THREADS": "1",
    }
    lines = [
        *(f"export {name}={shlex.quote(value)}" for name, value in settings.items()),
        f"cd {shlex.quote(str(HERE.parents[1]))}",
        shlex.join(
            [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist",
             "--basetemp", "/dev/shm/inside", str(HERE / "can_inside_uml.py")]
        ) + f" >{shlex.quote(str(log))} 2>&1",
    ]  # fmt: skip
    job.write_text("\n".join(lines) + "\n")
    kernel = subprocess.Popen(
        ["linux.uml", "mem=2G", "rootfstype=hostfs", "rootflags=/", "rw", "quiet",
         f"init={INIT}", f"UML_JOB={job}", f"UML_STATUS={status}", "con0=null,fd:1", "con=null"],
        env={**os.environ, "TMPDIR": str(tmp_path)},  # where its memory is: /dev/shm may be small
        stdin=subprocess.DEVNULL,
        stdout=(tmp_path / "console").open("wb"),
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )  # fmt: skip
    try:
        kernel.wait(timeout=1150)
    finally:
        if kernel.poll() is None:  # it is several processes
            os.killpg(kernel.pid, signal.SIGKILL)
    said = log.read_text(encoding="utf-8") if log.exists() else ""
    console = (tmp_path / "console").read_text(encoding="utf-8", errors="replace")
    assert status.exists(), console[-3000:]
    assert status.read_text().strip() == "0", said[-6000:]
    assert " passed" in said
    print(said)
