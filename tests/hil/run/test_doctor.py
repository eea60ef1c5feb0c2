"""gfmhil doctor: its findings, its advice, its exit codes, and that it changes nothing."""

import json
import os
from pathlib import Path

import pytest

from gfm_hil.cli import main
from gfm_hil.realtime.environment import environment
from gfm_hil.run import doctor

GOOD = {
    "preemption": "PREEMPT_RT",
    "cpus": 4,
    "isolated_cpus": "2-3",
    "smt": False,
    "governors": ["performance"],
    "deepest_idle_us": 2,
    "sched_fifo": True,
    "rt_priority": 50,
    "mlock": "unlimited",
    "rt_share": 0.95,
    "clock_source": "tsc",
    "shm_minutes": 60.0,
    "virtual_machine": "no",
    "steal_pct": 0.0,
    "load_average": [0.1, 0.1, 0.1],
    "can": {"can0": "up"},
    "can_modules": ["can", "vcan"],
}


def facts(**changed: object) -> doctor.Facts:
    """The facts of a good machine, with the given changes."""
    return {**environment(), **GOOD, **changed}


def line(what: str, **changed: object) -> doctor.Finding:
    """The finding of that name."""
    return {f.what: f for f in doctor.judge(facts(**changed))}[what]


def test_a_good_machine_is_green_and_has_nothing_to_do():
    findings = doctor.judge(facts())
    assert {(f.level, f.advice) for f in findings} == {("green", "")}
    assert doctor.worst(findings) == "green"


@pytest.mark.parametrize(
    ("what", "level", "advice", "changed"),
    [
        ("kernel", "yellow", "PREEMPT_RT", {"preemption": "PREEMPT_DYNAMIC (full)"}),
        ("kernel", "red", "PREEMPT_RT", {"preemption": "PREEMPT_DYNAMIC (voluntary)"}),
        ("kernel", "red", "PREEMPT_RT", {"preemption": "none or voluntary"}),
        ("processors", "red", "larger machine", {"cpus": 1}),
        ("processors", "yellow", "one side", {"cpus": 2}),
        ("isolated processors", "yellow", "deploy/tune-realtime", {"isolated_cpus": "none"}),
        ("hyper-threads", "yellow", "nosmt", {"smt": True}),
        ("frequency governor", "yellow", "--apply", {"governors": ["performance", "powersave"]}),
        ("deepest idle state", "yellow", "--apply", {"deepest_idle_us": 200}),
        ("SCHED_FIFO", "red", "LimitRTPRIO=50", {"sched_fifo": False, "rt_priority": 0}),
        ("SCHED_FIFO", "red", "LimitRTPRIO=50", {"rt_priority": 49}),
        ("locked memory", "red", "LimitMEMLOCK", {"mlock": "8192 KiB"}),
        ("real-time share", "red", "950000", {"rt_share": 0.0}),
        ("clock source", "red", "system call", {"clock_source": "hpet"}),
        ("/dev/shm", "red", "remount", {"shm_minutes": 0.5}),
        ("/dev/shm", "yellow", "remount", {"shm_minutes": 5.0}),
        ("/dev/shm", "red", "tmpfs", {"shm_minutes": None}),
        ("virtual machine", "yellow", "bare metal", {"virtual_machine": "KVM"}),
        ("virtual machine", "red", "host", {"virtual_machine": "KVM", "steal_pct": 3.0}),
        ("load", "yellow", "other work", {"load_average": [3.0, 0.0, 0.0]}),
        ("CAN", "yellow", "gfmhil-can@can0", {"can": {"can0": "down"}}),
        ("CAN", "yellow", "gfmhil-vcan@vcan0", {"can": {}}),
        ("CAN", "yellow", "gfmhil-udp", {"can": {}, "can_modules": []}),
        (
            "interrupts",
            "yellow",
            "/proc/irq/24/smp_affinity_list",
            {"interrupts": {"name": "irq 24, virtio", "processor": 1, "us": 5312.0}},
        ),
        (
            "interrupts",
            "yellow",
            "/proc/irq/24/smp_affinity_list",
            {"interrupts": {"name": "irq 24, virtio", "processor": 1, "times": 312}},
        ),
        ("versions", "red", "pip install pyzmq", {"pyzmq": None}),
    ],
)
def test_each_line_that_is_not_green_says_what_to_do(what, level, advice, changed):
    found = line(what, **changed)
    assert found.level == level
    assert advice in found.advice


def test_real_time_throttling_that_is_off_is_no_fault():
    assert line("real-time share", rt_share=-1e-6).found == "unlimited"


def test_it_reads_the_kernel_s_files(tmp_path):
    files = {
        "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "powersave",
        "sys/devices/system/cpu/cpu1/cpufreq/scaling_governor": "performance",
        "sys/devices/system/cpu/cpu0/cpuidle/state1/latency": "170",
        "sys/devices/system/cpu/cpu0/cpuidle/state1/disable": "1",
        "sys/devices/system/cpu/cpu1/cpuidle/state0/latency": "3",
        "sys/devices/system/cpu/cpu1/cpuidle/state0/disable": "0",
        "sys/devices/system/cpu/smt/active": "1",
        "proc/sys/kernel/sched_rt_runtime_us": "800000",
        "proc/sys/kernel/sched_rt_period_us": "1000000",
        "proc/self/status": "CapEff:\t0000000000800000",
        "proc/interrupts": " CPU0 CPU2\n 24: 7 312 IO-APIC 5-edge virtio\nNMI: 1 2 Non-maskable",
        "sys/class/net/can0/type": "280",
        "sys/class/net/can0/operstate": "down",
        "sys/class/net/eth0/type": "1",
        "sys/class/net/eth0/operstate": "up",
        f"lib/modules/{os.uname().release}/modules.dep": "kernel/drivers/net/can/vcan.ko.xz:",
        "sys/module/can_raw/refcnt": "0",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text + "\n")
    seen = doctor.look(tmp_path)
    assert seen["governors"] == ["performance", "powersave"]
    assert seen["deepest_idle_us"] == 3  # the deeper state is disabled
    assert (seen["smt"], seen["rt_share"], seen["rt_priority"]) == (True, 0.8, 99)
    assert (seen["can"], seen["can_modules"]) == ({"can0": "down"}, ["can-raw", "vcan"])
    counts = doctor.interrupt_counts(tmp_path)
    assert counts == {("irq 24, virtio", 0): 7, ("irq 24, virtio", 2): 312}
    assert seen["shm_minutes"] is None  # no such file below that root


def test_nothing_there_is_nothing_found(tmp_path):
    seen = doctor.look(tmp_path)
    assert (seen["governors"], seen["deepest_idle_us"], seen["rt_share"]) == ([], None, None)
    assert all(isinstance(f, doctor.Finding) for f in doctor.judge({**facts(), **seen}))


@pytest.mark.parametrize(
    ("changed", "strict", "code"),
    [({}, True, 0), ({"smt": True}, True, 0), ({"cpus": 1}, True, 3), ({"cpus": 1}, False, 0)],
)
def test_exit_code_is_3_only_if_strict_and_red(monkeypatch, capsys, changed, strict, code):
    there = facts(**changed)
    monkeypatch.setattr("gfm_hil.cli.doctor.examine", lambda: (there, doctor.judge(there)))
    assert main(["doctor", *(["--strict"] if strict else [])]) == code
    assert ("→" in capsys.readouterr().out) == bool(changed)


def test_it_says_the_same_in_a_table_and_as_json_and_changes_nothing(capsys):
    def settings() -> dict[Path, str]:
        found = [*Path("/proc/sys/kernel").glob("sched_rt_*")]
        found += Path("/sys/devices/system/cpu").glob("cpu*/cp*/s*g_governor")
        return {path: path.read_text() for path in found}

    before = settings()
    assert main(["doctor", "--json"]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)
    assert err == ""
    assert told["worst"] == doctor.worst(doctor.Finding(**f) for f in told["findings"])
    assert set(environment()) < set(told["facts"])
    assert main(["doctor"]) == 0
    table = capsys.readouterr().out
    assert all(f["what"] in table for f in told["findings"])
    assert settings() == before
