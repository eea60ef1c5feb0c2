"""Programs of others that measure how late a thread wakes: cyclictest of rt-tests, rtla of Linux.

Their threads wait for the same deadlines by the same calls as our own ``nanosleep``, on the same
processors, with the same priority and without a setting of the machine.
"""

import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from gfm_hil.bench.pair import Policy
from gfm_hil.realtime.priority import PRIORITY
from gfm_hil.run.attribution import Times
from gfm_hil.run.kernel_trace import tracefs

_LONGEST_NS = 2_000_000  # later ones count as the latest
_BUCKET_NS = 200  # of rtla
_MARGIN_S = 20.0
_ROW = re.compile(r"^(\d+)((?:[ \t]+\d+)+)[ \t]*$", re.M)


def read_cyclictest(text: str) -> Times:
    """Lateness in ns of all threads, from its JSON."""
    late = []
    for thread in json.loads(text)["thread"].values():
        at, counts = np.array([[int(k), n] for k, n in thread["histogram"].items()]).T
        beyond = thread["cycles"] - counts.sum()
        late += [np.repeat(at, counts), np.full(max(beyond, 0), thread["max"])]
    return np.concatenate(late)


def read_rtla(text: str) -> Times:
    """Lateness in ns of all threads, from the histogram of ``rtla timerlat hist --nano``."""
    heads = re.findall(r"\S+", re.findall(r"^Index.*$", text, re.M)[0])[1:]
    threads = [k for k, head in enumerate(heads) if head.startswith("Thr")]
    late = [np.zeros(0, np.int64)]
    for low, counts in _ROW.findall(text):
        n = sum(int(counts.split()[k]) for k in threads)
        late.append(np.full(n, int(low) + _BUCKET_NS // 2))
    over = re.findall(r"^over:(.*)$", text, re.M)[0].split()
    late.append(np.full(sum(int(over[k]) for k in threads), _LONGEST_NS))
    return np.concatenate(late)


def _cyclictest(cpus: str, policy: Policy, period_us: int, ticks: int, to: Path) -> list[str]:
    how = ["-p", str(PRIORITY), "--policy=fifo"] if policy == "fifo" else ["--policy=other"]
    limits = ["-l", str(ticks), "-h", str(_LONGEST_NS), f"--json={to}"]
    threads = ["-t", str(cpus.count(",") + 1), "-a", cpus, "-i", str(period_us), "-d", "0"]
    return ["cyclictest", "-m", "-q", "-N", "--default-system", *threads, *how, *limits]


def _rtla(cpus: str, policy: Policy, period_us: int, ticks: int, to: Path) -> list[str]:
    how = f"f:{PRIORITY}" if policy == "fifo" else "o:0"
    shape = ["-b", str(_BUCKET_NS), "-E", str(min(_LONGEST_NS // _BUCKET_NS, 9999))]
    seconds = max(1, round(ticks * period_us * 1e-6))
    line = ["rtla", "timerlat", "hist", "--nano", "--no-irq", "-c", cpus, "-P", how, *shape]
    line += ["-p", str(period_us), "-d", f"{seconds}s"]
    return ["sh", "-c", 'exec "$@" >"$0"', str(to), *line]


_Command = Callable[[str, Policy, int, int, Path], list[str]]
PROGRAMS: Mapping[str, tuple[_Command, Callable[[str], Times]]] = {
    "cyclictest": (_cyclictest, read_cyclictest), "rtla": (_rtla, read_rtla),
}  # fmt: skip


def missing(name: str) -> str:
    """The reason for which a program cannot measure here; "" if it can."""
    if shutil.which(name) is None:
        return f"{name}: not installed (Debian: {'rt-tests' if name == 'cyclictest' else name})"
    if name != "rtla":
        return ""
    place = tracefs()
    if isinstance(place, str):
        return f"rtla: {place}"
    if "timerlat" in (place / "available_tracers").read_text("utf-8"):
        return ""
    return "rtla: this kernel is built without its tracer timerlat (CONFIG_TIMERLAT_TRACER)"


def measure(
    name: str, processors: Collection[int], policy: Policy, period_ns: int, seconds: float
) -> Times:
    """Lateness in ns, of all processors, in no order; none if the program fails."""
    command, read = PROGRAMS[name]
    cpus = ",".join(map(str, sorted(processors)))
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as place:
        to, ticks = Path(place) / "out", max(1, round(seconds * 1e9 / period_ns))
        line = command(cpus, policy, period_ns // 1000, ticks, to)
        subprocess.run(
            line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False,
            timeout=seconds + _MARGIN_S,
        )  # fmt: skip
        return read(to.read_text("utf-8")) if to.exists() else np.zeros(0, np.int64)
