"""Is this machine fit for real time? Judges the badge line by line and gives advice.

Green: nothing to do. Yellow: the longest times are longer than necessary. Red: ticks will be late,
or the machine refuses something that a run needs.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gfm_hil.realtime.environment import StealTime, environment
from gfm_hil.realtime.priority import PRIORITY
from gfm_hil.recording.columns import BYTES_PER_TICK

Level = Literal["green", "yellow", "red"]
Facts = dict[str, Any]

_STEAL_OVER_S = 1.0
_CAN = 280  # ARPHRD_CAN of if_arp.h
_CAP_SYS_NICE = 23
#: read without a system call, see Documentation/timers/timekeeping.rst of Linux
_FAST_CLOCKS = {"tsc", "arch_sys_counter", "riscv_clocksource", "kvm-clock"}
_FAST_CLOCKS |= {"hyperv_clocksource_tsc_page"}
_WAKE_US = 20  # of a tick of 100 µs
_MINUTE_BYTES = 60 * 10_000 * BYTES_PER_TICK
_NEEDED = ("numpy", "numba", "pyzmq", "python-can")


class Finding(NamedTuple):
    """One line of the doctor's table; ``advice`` is empty if there is nothing to do."""

    what: str
    found: str
    level: Level
    advice: str = ""


def examine() -> tuple[Facts, list[Finding]]:
    """The machine's badge and further facts, and the findings; changes nothing."""
    steal = StealTime()
    time.sleep(_STEAL_OVER_S)
    facts = {**environment(), **look(Path("/")), "steal_pct": steal.percent()}
    return facts, judge(facts)


def verdict() -> dict[str, Any]:
    """The worst level of this machine's findings, and the findings that are not green, in words.

    It takes some milliseconds, as it does not measure how much time the host takes.
    """
    findings = judge({**environment(), **look(Path("/")), "steal_pct": None})
    said = [f"{f.what} {f.found}" for f in findings if f.level != "green"]
    return {"worst": worst(findings), "findings": said}


def look(root: Path) -> Facts:
    """Facts beyond the badge, from files below ``root`` and the limits of this process."""
    cpu = root / "sys/devices/system/cpu"
    governors = {_text(f) for f in cpu.glob("cpu[0-9]*/cpufreq/scaling_governor")}
    deepest = [
        int(_text(state / "latency"))
        for state in cpu.glob("cpu[0-9]*/cpuidle/state*")
        if _text(state / "disable") == "0"
    ]
    memory = root / "dev/shm"
    runtime = _text(root / "proc/sys/kernel/sched_rt_runtime_us")
    period = _text(root / "proc/sys/kernel/sched_rt_period_us")
    return {
        "governors": sorted(governors),
        "deepest_idle_us": max(deepest, default=None),
        "smt": _text(cpu / "smt/active") == "1",
        "rt_share": int(runtime) / int(period) if runtime and period else None,
        "rt_priority": _allowed_priority(root),
        "shm_minutes": round(shutil.disk_usage(memory).free / _MINUTE_BYTES, 1)
        if memory.is_dir()
        else None,
        "can": {
            net.name: _text(net / "operstate")
            for net in sorted((root / "sys/class/net").glob("*"))
            if _text(net / "type") == str(_CAN)
        },
        "can_modules": _can_modules(root),
    }


def _allowed_priority(root: Path) -> int:
    """The highest real-time priority that this process may use."""
    held = re.search(r"^CapEff:\s*(\w+)", _text(root / "proc/self/status"), re.M)
    if held and int(held.group(1), 16) >> _CAP_SYS_NICE & 1:
        return 99
    return resource.getrlimit(resource.RLIMIT_RTPRIO)[0]


def _can_modules(root: Path) -> list[str]:
    """Which of the kernel's CAN drivers are loaded, built in, or loadable."""
    drivers = root / "lib/modules" / os.uname().release
    listed = _text(drivers / "modules.dep") + "\n" + _text(drivers / "modules.builtin")
    found = set(re.findall(r"/(can|vcan|can-raw|can-dev)\.ko", listed))
    loaded = ("can", "vcan", "can_raw", "can_dev")
    return sorted(
        found | {m.replace("_", "-") for m in loaded if (root / "sys/module" / m).is_dir()}
    )


def judge(facts: Facts) -> list[Finding]:
    """One finding per rule, in the order of the table."""
    return [rule(facts) for rule in _RULES]


def worst(findings: Iterable[Finding]) -> Level:
    """The level of the worst of them."""
    levels = {f.level for f in findings}
    return "red" if "red" in levels else "yellow" if "yellow" in levels else "green"


def _kernel(facts: Facts) -> Finding:
    model = facts["preemption"]
    level: Level = "green" if model == "PREEMPT_RT" else "yellow"
    if re.search(r"none|voluntary", model):
        level = "red"
    advice = (
        "boot a PREEMPT_RT kernel (Debian: linux-image-rt-amd64), or preempt=full on its command "
        "line"
    )
    return Finding(
        "kernel", f"{facts['kernel']}, {model}", level, "" if level == "green" else advice
    )


def _processors(facts: Facts) -> Finding:
    n = facts["cpus"]
    level: Level = "red" if n < 2 else "yellow" if n < 3 else "green"
    advice = {
        "red": "the two sides need a processor each: a larger machine, or one for each side",
        "yellow": "the loops leave none for other work: one side on a machine of its own",
    }
    found = f"{n} of {facts['cpus_of_machine']}, {facts['cpu']}"
    return Finding("processors", found, level, advice.get(level, ""))


def _isolated(facts: Facts) -> Finding:
    found = facts["isolated_cpus"]
    if found != "none":
        return Finding("isolated processors", found, "green")
    advice = "isolate the loops' processors at boot: deploy/tune-realtime prints the options"
    return Finding("isolated processors", found, "yellow", advice)


def _threads(facts: Facts) -> Finding:
    if not facts["smt"]:
        return Finding("hyper-threads", "off", "green")
    advice = "keep the sibling of a loop's processor free, or nosmt on the kernel's command line"
    return Finding("hyper-threads", "on", "yellow", advice)


def _governor(facts: Facts) -> Finding:
    names = ", ".join(facts["governors"])
    if facts["governors"] in ([], ["performance"]):
        return Finding("frequency governor", names or "none", "green")
    return Finding(
        "frequency governor", names, "yellow", "performance: deploy/tune-realtime --apply"
    )


def _idle(facts: Facts) -> Finding:
    us = facts["deepest_idle_us"]
    if us is None or us <= _WAKE_US:
        return Finding("deepest idle state", "none" if us is None else f"wakes in {us} µs", "green")
    return Finding(
        "deepest idle state", f"wakes in {us} µs", "yellow", "deploy/tune-realtime --apply"
    )


def _priority(facts: Facts) -> Finding:
    highest = facts["rt_priority"]
    found = f"up to {highest}" if facts["sched_fifo"] and highest else "refused"
    if facts["sched_fifo"] and highest >= PRIORITY:
        return Finding("SCHED_FIFO", found, "green")
    n = PRIORITY
    advice = (
        f"the loops ask for {n}: LimitRTPRIO={n} in a unit, --ulimit rtprio={n} for a container, "
        f"'<user> - rtprio {n}' in /etc/security/limits.d for a login"
    )
    return Finding("SCHED_FIFO", found, "red", advice)


def _memory(facts: Facts) -> Finding:
    if facts["mlock"] == "unlimited":
        return Finding("locked memory", "unlimited", "green")
    advice = (
        "unlimited: LimitMEMLOCK=infinity in a unit, --ulimit memlock=-1 for a container, "
        "'<user> - memlock unlimited' in /etc/security/limits.d for a login"
    )
    return Finding("locked memory", facts["mlock"], "red", advice)


def _throttling(facts: Facts) -> Finding:
    share = facts["rt_share"]
    if share is None:
        return Finding("real-time share", "unknown", "green")
    if share < 0:
        return Finding("real-time share", "unlimited", "green")
    level: Level = "green" if share >= 0.9 else "red"  # the loops sleep in every tick
    advice = "sysctl kernel.sched_rt_runtime_us=950000" if level == "red" else ""
    return Finding("real-time share", f"{share:.0%}", level, advice)


def _clock(facts: Facts) -> Finding:
    name = facts["clock_source"]
    if name in _FAST_CLOCKS:
        return Finding("clock source", name, "green")
    advice = "every look at the clock is a system call: tsc=reliable, or a look into dmesg why not"
    return Finding("clock source", name or "unknown", "red" if name else "yellow", advice)


def _room(facts: Facts) -> Finding:
    minutes = facts["shm_minutes"]
    if minutes is None:
        advice = "recordings go to the disk, and a tick may wait for it: mount a tmpfs"
        return Finding("/dev/shm", "none", "red", advice)
    level: Level = "red" if minutes < 1 else "yellow" if minutes < 10 else "green"
    advice = "a longer run records to the disk: mount -o remount,size=… /dev/shm"
    found = f"room for {minutes:g} min at 10 kHz"
    return Finding("/dev/shm", found, level, "" if level == "green" else advice)


def _virtual(facts: Facts) -> Finding:
    kind, steal = facts["virtual_machine"], facts["steal_pct"]
    if kind == "no":
        return Finding("virtual machine", "no", "green")
    level: Level = "red" if (steal or 0.0) > 1 else "yellow"
    found = kind if steal is None else f"{kind}, host takes {steal:g} %"
    advice = "the host can stop it for milliseconds: bare metal, or processors pinned by the host"
    return Finding("virtual machine", found, level, advice)


def _load(facts: Facts) -> Finding:
    load = facts["load_average"][0]
    busy = load / facts["cpus"] > 0.5
    advice = "other work runs on this machine: stop it, or isolate the loops' processors"
    return Finding("load", f"{load:g}", "yellow" if busy else "green", advice if busy else "")


def _can(facts: Facts) -> Finding:
    names = [f"{name} {state}" for name, state in facts["can"].items()]
    if any(not name.endswith(" down") for name in names):
        return Finding("CAN", ", ".join(names), "green")
    if names:
        advice = f"systemctl start gfmhil-can@{next(iter(facts['can']))}"
        return Finding("CAN", ", ".join(names), "yellow", advice)
    if facts["can_modules"]:
        advice = "for the link can: plug an adapter in, or systemctl start gfmhil-vcan@vcan0"
        return Finding("CAN", f"drivers {', '.join(facts['can_modules'])}", "yellow", advice)
    advice = "for the link can: a kernel with CAN; the interface gfmhil-udp does without"
    return Finding("CAN", "no driver", "yellow", advice)


def _versions(facts: Facts) -> Finding:
    names = ("python", "gfmhil", *_NEEDED, "libzmq")
    missing = [name for name in _NEEDED if facts[name] is None]
    found = ", ".join(f"{name} {facts[name]}" for name in names if facts[name])
    if missing:
        return Finding("versions", found, "red", f"pip install {' '.join(missing)}")
    return Finding("versions", found, "green")


_RULES: tuple[Callable[[Facts], Finding], ...] = (
    _kernel, _processors, _isolated, _threads, _governor, _idle, _priority, _memory, _throttling,
    _clock, _room, _virtual, _load, _can, _versions,
)  # fmt: skip


def _text(path: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8").strip()
    return ""
