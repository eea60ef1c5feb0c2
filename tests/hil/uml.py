"""A kernel with CAN as a process, user-mode Linux on the host's files, that runs one job."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
INIT = HERE.parent / "uml" / "init.sh"


class Kernel:
    """Boots at once and runs ``can_inside_uml.py`` under pytest; takes some minutes.

    So it is started before the other tests, and looked at after them.
    """

    def __init__(self) -> None:
        self._place = tempfile.TemporaryDirectory(prefix="gfmhil-uml-")
        folder = Path(self._place.name)
        job = folder / "job.sh"
        self._status, self._log, self._console = (
            folder / name for name in ("status", "log", "console")
        )
        # hostfs cuts times of files to seconds, so that a cache of compiled code shared with the
        # host would be thrown away by the one and then by the other
        settings = {
            **{name: os.environ[name] for name in ("PATH", "PYTHONPATH") if name in os.environ},
            "HOME": str(folder),
            "TMPDIR": "/dev/shm",  # in the host's, what no process of the host owns is tidied up
            "NUMBA_CACHE_DIR": str(HERE.parents[1] / ".pytest_cache" / "uml"),
            "MPLBACKEND": "Agg",
            "OPENBLAS_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist"]
        command += ["--basetemp", "/dev/shm/inside", str(HERE / "can_inside_uml.py")]
        lines = [
            *(f"export {name}={shlex.quote(value)}" for name, value in settings.items()),
            f"cd {shlex.quote(str(HERE.parents[1]))}",
            shlex.join(command) + f" >{shlex.quote(str(self._log))} 2>&1",
        ]
        job.write_text("\n".join(lines) + "\n")
        self._kernel = subprocess.Popen(
            ["linux.uml", "mem=2G", "rootfstype=hostfs", "rootflags=/", "rw", "quiet",
             f"init={INIT}", f"UML_JOB={job}", f"UML_STATUS={self._status}",
             "con0=null,fd:1", "con=null"],
            env={**os.environ, "TMPDIR": str(folder)},  # its memory: /dev/shm may be small
            stdin=subprocess.DEVNULL,
            stdout=self._console.open("wb"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip

    def result(self, timeout: float) -> tuple[str, str]:
        """Exit status of the job ("" if it did not end) and what it or the kernel said."""
        try:
            self._kernel.wait(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.end()
        said = self._log if self._log.exists() else self._console
        status = self._status.read_text().strip() if self._status.exists() else ""
        return status, said.read_text(encoding="utf-8", errors="replace")[-6000:]

    def end(self) -> None:
        """Kill it, if it is still there: it is several processes."""
        if self._kernel.poll() is None:
            os.killpg(self._kernel.pid, signal.SIGKILL)
            self._kernel.wait()

    def clear(self) -> None:
        """End it and remove its files."""
        self.end()
        self._place.cleanup()
