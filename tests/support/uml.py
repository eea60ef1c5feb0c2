"""A kernel with CAN and netem as a process: user-mode Linux on the host's files, with one job."""

import os
import shlex
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from gfm_hil.links import link_kind

ROOT = Path(__file__).resolve().parents[2]
INIT = ROOT / "tests" / "uml" / "init.sh"
TESTS = ("tests/hil/links/can_inside_uml.py", "tests/hil/bench/netem_inside_uml.py")
PACKAGES = ("hil", "runtime", "plant_emulator", "design")


class Kernel:
    """Boots and runs ``TESTS`` under pytest; takes some minutes.

    So it starts before the other tests, and its result is checked after them. Inside, where system
    calls are slow, compiling would take ten minutes; a bus on the loopback device needs the same
    compiled code, so the host compiles first what its own tests have not compiled yet.
    """

    def __init__(self) -> None:
        self._place = tempfile.TemporaryDirectory(prefix="gfmhil-uml-")
        folder = Path(self._place.name)
        job = folder / "job.sh"
        self._status, self._log, self._console = (
            folder / name for name in ("status", "log", "console")
        )
        settings = {
            "PATH": os.environ["PATH"],
            "PYTHONPATH": os.pathsep.join(
                [*(str(ROOT / name) for name in PACKAGES), str(_without_asammdf(folder))]
            ),
            "HOME": str(folder),
            "MPLBACKEND": "Agg",
            "OPENBLAS_NUM_THREADS": "1",
        }
        test = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *TESTS]
        # in the host's folder, the host would remove files that none of its processes owns
        inside = {**settings, "TMPDIR": "/dev/shm"}
        lines = [
            *(f"export {name}={shlex.quote(value)}" for name, value in inside.items()),
            f"cd {shlex.quote(str(ROOT))}",
            shlex.join([*test, "--basetemp", "/dev/shm/inside"])
            + f" >{shlex.quote(str(self._log))} 2>&1",
        ]
        job.write_text("\n".join(lines) + "\n")
        first = "in_process_in_counts or loss"
        compiling = [*test, "-k", first, "--basetemp", str(folder / "first")]
        kernel = ["linux.uml", "mem=2G", "rootfstype=hostfs", "rootflags=/", "rw", "quiet",
                  f"init={INIT}", f"UML_JOB={job}", f"UML_STATUS={self._status}",
                  "con0=null,fd:1", "con=null"]  # fmt: skip
        self._kernel = subprocess.Popen(
            ["sh", "-c", f"{shlex.join(compiling)}; exec {shlex.join(kernel)}"],
            cwd=ROOT,
            # its memory is a file in TMPDIR, since /dev/shm may be small
            env={
                **os.environ, **settings, "TMPDIR": str(folder),
                "GFMHIL_TEST_BUS": link_kind("can").fresh(folder),
            },
            stdin=subprocess.DEVNULL,
            stdout=self._console.open("wb"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
            # its processes take turns; a processor that went idle in between made it 5 times slower
            preexec_fn=lambda: os.sched_setaffinity(0, {max(os.sched_getaffinity(0))}),
        )  # fmt: skip

    def result(self, timeout: float) -> tuple[str, str]:
        """Exit status of the job ("" if it did not end), and its or the kernel's output."""
        try:
            self._kernel.wait(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.end()
        said = self._log if self._log.exists() else self._console
        status = self._status.read_text().strip() if self._status.exists() else ""
        return status, said.read_text(encoding="utf-8", errors="replace")[-6000:]

    def end(self) -> None:
        """Kill all its processes that still run."""
        if self._kernel.poll() is None:
            os.killpg(self._kernel.pid, signal.SIGKILL)
            self._kernel.wait()

    def clear(self) -> None:
        """End it and remove its files."""
        self.end()
        self._place.cleanup()


def _without_asammdf(folder: Path) -> Path:
    """A place for PYTHONPATH in which asammdf cannot be imported; no run needs it.

    With it, python-can would load pandas and sympy in each process: a third of its start.
    """
    place = folder / "without"
    place.mkdir()
    (place / "asammdf.py").write_text('raise ImportError("asammdf is left out here")\n')
    return place
