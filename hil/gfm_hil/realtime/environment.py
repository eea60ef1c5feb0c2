"""What timing on this machine depends on: its badge, and caveats for readers of its times."""

import math
import os
import platform
import re
import resource
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_CPU = Path("/sys/devices/system/cpu")
_PACKAGES = ("gfmhil", "numpy", "numba", "llvmlite", "pyzmq", "python-can")


def environment() -> dict[str, Any]:
    """The machine as plain data, without its host name; a value that is unknown is None."""
    return {
        "kernel": platform.release(),
        "preemption": preemption(),
        "cpu": _cpu_model(),
        "cpus": len(os.sched_getaffinity(0)),
        "cpus_of_machine": os.cpu_count(),
        "governor": _read(_CPU / "cpu0/cpufreq/scaling_governor"),
        "isolated_cpus": _read(_CPU / "isolated") or "none",
        "virtual_machine": virtual_machine(),
        "container": _container(),
        "clock_source": _read(
            Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
        ),
        "sched_fifo": may_sched_fifo(),
        "mlock": _mlock(),
        "rt_throttling": _throttling(),
        "load_average": [round(x, 2) for x in os.getloadavg()],
        "python": platform.python_version(),
        **{name: _version(name) for name in _PACKAGES},
        "libzmq": _libzmq(),
    }


def caveats(badge: dict[str, Any]) -> list[str]:
    """Caveats about times from a machine with this badge, one sentence each."""
    said = []
    if badge["virtual_machine"] != "no":
        said.append(
            "A virtual machine: its host can stop it at any time for milliseconds. The largest "
            "times are the host's; compare medians and ratios."
        )
    if (badge.get("steal_pct") or 0) > 0.1:
        said.append(f"The host took {badge['steal_pct']:g} % of the processors' time meanwhile.")
    if not badge["sched_fifo"]:
        said.append(
            "No right to SCHED_FIFO: other work competes on equal terms, and the tail shows it."
        )
    if badge["isolated_cpus"] == "none":
        said.append("No isolated processors: the kernel's own work runs on the measured ones.")
    if badge["governor"] not in (None, "performance"):
        said.append(
            f"Frequency governor {badge['governor']}: a processor that slept starts slowly."
        )
    if badge["cpus"] < 2:
        said.append("One processor: the two sides share it, and no time is that of a bench.")
    busy = badge["load_average"][0] / badge["cpus"]
    if busy > 0.5:
        said.append(
            f"Load average {badge['load_average'][0]:g} on {badge['cpus']} processors at the start:"
            " other work ran at the same time."
        )
    return said


class StealTime:
    """Share of processor time that a virtual machine's host has stolen since the start, %."""

    def __init__(self) -> None:
        self._before = self._ticks()

    def percent(self) -> float | None:
        """The share; None if the kernel does not report it."""
        now = self._ticks()
        if self._before is None or now is None:
            return None
        passed = sum(now) - sum(self._before)
        return round(100 * (now[7] - self._before[7]) / passed, 3) if passed else 0.0

    @staticmethod
    def _ticks() -> list[int] | None:
        first = (_read(Path("/proc/stat")) or "").splitlines()[:1]
        found = [int(x) for x in first[0].split()[1:9]] if first else []
        return found if len(found) == 8 else None


def preemption() -> str:
    """Preemption model of the kernel."""
    if _read(Path("/sys/kernel/realtime")) == "1":
        return "PREEMPT_RT"
    models = _read(Path("/sys/kernel/debug/sched/preempt")) or ""
    chosen = re.search(r"\((\w+)\)", models)
    built = re.search(r"PREEMPT\w*", platform.version())
    name = built.group() if built else "none or voluntary"
    return f"{name} ({chosen.group(1)})" if chosen else name


def virtual_machine() -> str:
    """``no``, or the hypervisor, as reported by the kernel."""
    flags = re.search(r"^flags\s*:(.*)$", _read(Path("/proc/cpuinfo")) or "", re.M)
    inside = flags is not None and "hypervisor" in flags.group(1).split()
    kind = _read(Path("/sys/hypervisor/type")) or _read(Path("/sys/class/dmi/id/product_name"))
    return (kind or "yes") if inside else "no"


def may_sched_fifo() -> bool:
    """Whether this thread may have a real-time priority; tries it and restores the old one."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    return _done(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))) and _done(
        lambda: os.sched_setscheduler(0, *before)
    )


def _done(work: Callable[[], None]) -> bool:
    try:
        work()
    except OSError:
        return False
    return True


def available_memory() -> float:
    """What this machine has left for processes, bytes; infinite where it does not say."""
    left = re.search(r"^MemAvailable:\s*(\d+) kB", _read(Path("/proc/meminfo")) or "", re.M)
    return 1024.0 * int(left[1]) if left else math.inf


def _mlock() -> str:
    capabilities = re.search(r"^CapEff:\s*(\w+)", _read(Path("/proc/self/status")) or "", re.M)
    if capabilities and int(capabilities.group(1), 16) >> 14 & 1:  # CAP_IPC_LOCK
        return "unlimited"
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    return "unlimited" if limit == resource.RLIM_INFINITY else f"{limit >> 10} KiB"


def _throttling() -> str | None:
    runtime, period = (
        _read(Path(f"/proc/sys/kernel/sched_rt_{x}_us")) for x in ("runtime", "period")
    )
    if not runtime or not period:
        return None
    return "off" if int(runtime) < 0 else f"{int(runtime) / int(period):.0%} of the time at most"


def _cpu_model() -> str:
    found = re.search(r"^model name\s*:\s*(.+)$", _read(Path("/proc/cpuinfo")) or "", re.M)
    return found.group(1) if found else platform.machine()


def _container() -> str:
    known = {"/.dockerenv": "docker", "/run/.containerenv": "podman"}
    return next((name for path, name in known.items() if Path(path).exists()), "no")


def _version(package: str) -> str | None:
    with suppress(PackageNotFoundError):
        return version(package)
    return None


def _libzmq() -> str | None:
    with suppress(ImportError):
        import zmq

        return zmq.zmq_version()
    return None


def _read(path: Path) -> str | None:
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8").strip()
    return None
