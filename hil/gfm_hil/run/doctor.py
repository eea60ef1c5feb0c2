"""Is this machine fit for real time? Judges the badge line by line and gives advice.

Green: nothing to do. Yellow: the longest times are longer than necessary. Red: ticks will be late,
or the machine refuses something that a run needs.
"""

import os
import re
import resource
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gfm_hil.realtime.environment import StealTime, environment
from gfm_hil.realtime.priority import PRIORITY
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.run.processor_time import ProcessorTime
from gfm_hil.run.stalls import ProcessorWatch

Level = Literal["green", "yellow", "red"]
Facts = dict[str, Any]

_STEAL_OVER_S = 1.0
_CAN = 280  # ARPHRD_CAN of if_arp.h
_CAP_SYS_NICE = 23
#: read without a system call, see Documentation/timers/timekeeping.rst of Linux
_FAST_CLOCKS = {"tsc", "arch_sys_counter", "riscv_clocksource", "kvm-clock"}
_FAST_CLOCKS |= {"hyperv_clocksource_tsc_page"}
_IRQ_US, _IRQ_TIMES = 1000, 100  # of an interrupt in a second on one processor
_WAKE_US = 20  # of a tick of 100 µs
_MINUTE_BYTES = 60 * 10_000 * ColumnSet().bytes_per_tick()
_NEEDED = ("numpy", "numba", "pyzmq", "python-can")


class Finding(NamedTuple):
    """One line of the doctor's table; ``advice`` is empty if there is nothing to do."""

    what: str
    found: str
    level: Level
    advice: str = ""


def examine() -> tuple[Facts, list[Finding]]:
    """The machine's badge and further facts, and the findings; changes nothing."""
    steal, before = StealTime(), interrupt_counts(Path("/"))
    with ProcessorWatch() as watch:
        watch.begin(dict.fromkeys(os.sched_getaffinity(0), -1), 0)
        time.sleep(_STEAL_OVER_S)
    facts = {**environment(), **look(Path("/")), "steal_pct": steal.percent()}
    facts["interrupts"] = _busiest(watch.taken, before, interrupt_counts(Path("/")))
    return facts, judge(facts)


def interrupt_counts(root: Path) -> dict[tuple[str, int], int]:
    """How often each device has interrupted each processor, by "irq NUMBER, NAME" and processor."""
    head, *lines = _text(root / "proc/interrupts").splitlines() or [""]
    cpus, counts = [int(name.removeprefix("CPU")) for name in head.split()], {}
    for line in lines:
        number, *rest = line.split()
        if number[:-1].isdecimal() and len(rest) > len(cpus):
            for cpu, count in zip(cpus, rest, strict=False):
                counts[f"irq {number[:-1]}, {rest[-1]}", cpu] = int(count)
    return counts


def _busiest(
    taken: ProcessorTime | None, before: dict[tuple[str, int], int], now: dict[tuple[str, int], int]
) -> dict[str, Any] | None:
    """The device that took most time of a processor, or without a trace the one that interrupted
    most often; None if none did."""
    if taken is not None and taken.method == "trace":
        times = [one for one in taken.totals() if one[0].startswith("irq ")]
        return (
            {"name": times[0][0], "processor": times[0][1], "us": times[0][2] / 1e3}
            if times
            else None
        )
    grown = {key: count - before.get(key, count) for key, count in now.items()}
    (name, processor), count = max(grown.items(), key=lambda one: one[1], default=(("", 0), 0))
    return {"name": name, "processor": processor, "times": count} if count else None


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
        "interrupts": None,
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
    return [
        Finding(what, found, level, "" if level == "green" else advice)
        for what, found, level, advice in (*_judge_processors(facts), *_judge_rest(facts))
    ]


# what, found, level, and what to do unless that is green
_Row = tuple[str, str, Level, str]


def _judge_processors(facts: Facts) -> Iterator[_Row]:
    """The kernel, and what it does with the processors."""
    model, cpus = facts["preemption"], facts["cpus"]
    slow: Level = "red" if re.search(r"none|voluntary", model) else "yellow"
    yield (
        "kernel", f"{facts['kernel']}, {model}", "green" if model == "PREEMPT_RT" else slow,
        "boot a PREEMPT_RT kernel (Debian: linux-image-rt-amd64), or preempt=full on its command "
        "line",
    )  # fmt: skip
    few: Level = "red" if cpus < 2 else "yellow" if cpus < 3 else "green"
    yield (
        "processors", f"{cpus} of {facts['cpus_of_machine']}, {facts['cpu']}", few,
        "the two sides need a processor each: a larger machine, or one for each side" if cpus < 2
        else "the loops leave none for other work: one side on a machine of its own",
    )  # fmt: skip
    isolated = facts["isolated_cpus"]
    yield (
        "isolated processors", isolated, "yellow" if isolated == "none" else "green",
        "isolate the loops' processors at boot: deploy/tune-realtime prints the options",
    )  # fmt: skip
    yield (
        "hyper-threads", *(("on", "yellow") if facts["smt"] else ("off", "green")),
        "keep the sibling of a loop's processor free, or nosmt on the kernel's command line",
    )  # fmt: skip
    governors, us = facts["governors"], facts["deepest_idle_us"]
    yield (
        "frequency governor", ", ".join(governors) or "none",
        "green" if governors in ([], ["performance"]) else "yellow",
        "performance: deploy/tune-realtime --apply",
    )  # fmt: skip
    yield (
        "deepest idle state", "none" if us is None else f"wakes in {us} µs",
        "yellow" if (us or 0) > _WAKE_US else "green", "deploy/tune-realtime --apply",
    )  # fmt: skip


def _judge_rest(facts: Facts) -> Iterator[_Row]:
    """Rights, clock, memory, other work, and what is installed."""
    highest, fifo, n = facts["rt_priority"], facts["sched_fifo"], PRIORITY
    yield (
        "SCHED_FIFO", f"up to {highest}" if fifo and highest else "refused",
        "green" if fifo and highest >= n else "red",
        f"the loops ask for {n}: LimitRTPRIO={n} in a unit, --ulimit rtprio={n} for a container, "
        f"'<user> - rtprio {n}' in /etc/security/limits.d for a login",
    )  # fmt: skip
    yield (
        "locked memory", facts["mlock"], "green" if facts["mlock"] == "unlimited" else "red",
        "unlimited: LimitMEMLOCK=infinity in a unit, --ulimit memlock=-1 for a container, "
        "'<user> - memlock unlimited' in /etc/security/limits.d for a login",
    )  # fmt: skip
    share = facts["rt_share"]
    found = "unknown" if share is None else "unlimited" if share < 0 else f"{share:.0%}"
    scarce = share is not None and 0 <= share < 0.9  # the loops sleep in every tick
    advice = "sysctl kernel.sched_rt_runtime_us=950000"
    yield "real-time share", found, "red" if scarce else "green", advice
    clock, minutes = facts["clock_source"], facts["shm_minutes"]
    slow: Level = "red" if clock else "yellow"
    yield (
        "clock source", clock or "unknown", "green" if clock in _FAST_CLOCKS else slow,
        "every look at the clock is a system call: tsc=reliable, or a look into dmesg why not",
    )  # fmt: skip
    if minutes is None:
        advice = "recordings go to the disk, and a tick may wait for it: mount a tmpfs"
        yield "/dev/shm", "none", "red", advice
    else:
        room: Level = "red" if minutes < 1 else "yellow" if minutes < 10 else "green"
        advice = "a longer run records to the disk: mount -o remount,size=… /dev/shm"
        yield "/dev/shm", f"room for {minutes:g} min at 10 kHz", room, advice
    kind, steal = facts["virtual_machine"], facts["steal_pct"]
    stopped: Level = "red" if (steal or 0.0) > 1 else "yellow"
    yield (
        "virtual machine",
        kind if steal is None or kind == "no" else f"{kind}, host takes {steal:g} %",
        "green" if kind == "no" else stopped,
        "the host can stop it for milliseconds: bare metal, or processors pinned by the host",
    )
    load = facts["load_average"][0]
    yield (
        "load", f"{load:g}", "yellow" if load / facts["cpus"] > 0.5 else "green",
        "other work runs on this machine: stop it, or isolate the loops' processors",
    )  # fmt: skip
    yield ("CAN", *_can(facts))
    yield ("interrupts", *_interrupts(facts.get("interrupts")))
    names = ("python", "gfmhil", *_NEEDED, "libzmq")
    missing = [name for name in _NEEDED if facts[name] is None]
    found = ", ".join(f"{name} {facts[name]}" for name in names if facts[name])
    yield "versions", found, "red" if missing else "green", f"pip install {' '.join(missing)}"


def _can(facts: Facts) -> tuple[str, Level, str]:
    names = [f"{name} {state}" for name, state in facts["can"].items()]
    if names:
        up = any(not name.endswith(" down") for name in names)
        advice = f"systemctl start gfmhil-can@{next(iter(facts['can']))}"
        return ", ".join(names), "green" if up else "yellow", advice
    if facts["can_modules"]:
        advice = "for the link can: plug an adapter in, or systemctl start gfmhil-vcan@vcan0"
        return f"drivers {', '.join(facts['can_modules'])}", "yellow", advice
    advice = "for the link can: a kernel with CAN; the interface gfmhil-udp does without"
    return "no driver", "yellow", advice


def _interrupts(busiest: dict[str, Any] | None) -> tuple[str, Level, str]:
    """Which device takes most of a processor, and how to move it away."""
    if busiest is None:
        return "of no device", "green", ""
    name, cpu = busiest["name"], busiest["processor"]
    if "us" in busiest:
        took, much = f"took {busiest['us']:.0f} µs", busiest["us"] > _IRQ_US
    else:
        took, much = f"came {busiest['times']} times", busiest["times"] > _IRQ_TIMES
    place = f"/proc/irq/{name.split(',')[0].removeprefix('irq ')}/smp_affinity_list"
    advice = f"move it to a processor without a loop: echo NUMBER > {place}"
    found = f"{name}, {took} in {_STEAL_OVER_S:g} s on processor {cpu}"
    return found, "yellow" if much else "green", advice


def worst(findings: Iterable[Finding]) -> Level:
    """The level of the worst of them."""
    levels = {f.level for f in findings}
    return "red" if "red" in levels else "yellow" if "yellow" in levels else "green"


def _text(path: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8").strip()
    return ""
