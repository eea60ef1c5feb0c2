"""The services compile, run and get their real-time rights within their units' restrictions.

The tests do not start them with systemd: they take the limits, the dropped capabilities and the
filter of system calls from the units and set them before the command is executed. If root itself
may not raise a limit, as in some containers, they grant the equivalent capability instead.
"""

import ctypes
import errno
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from gfm_hil.scenario import toml_text

UNITS = Path(__file__).resolve().parents[1] / "deploy" / "systemd"
ROLES = ("controller", "plant")
PR_SET_NO_NEW_PRIVS, PR_CAPBSET_DROP, CAPABILITIES = 38, 24, range(41)
PR_SET_MDWE, PR_GET_MDWE = 65, 66
ALLOW, ERRNO = 0x7FFF0000, 0x00050000  # SCMP_ACT_* of seccomp.h
CAP_SYS_NICE, CAP_IPC_LOCK = 23, 14
LIMITS = {
    "LimitRTPRIO": (resource.RLIMIT_RTPRIO, CAP_SYS_NICE),
    "LimitMEMLOCK": (resource.RLIMIT_MEMLOCK, CAP_IPC_LOCK),
}

pytestmark = [
    pytest.mark.apt,
    pytest.mark.full,
    pytest.mark.timeout(600),
    pytest.mark.skipif(
        shutil.which("systemd-analyze") is None or os.geteuid() != 0,
        reason="needs systemd-analyze, and root, whose rights are given up",
    ),
]


def setting(role: str, key: str) -> list[str]:
    """The values of one key of a side's unit."""
    lines = (UNITS / f"gfmhil-{role}@.service").read_text().splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(f"{key}=")]


def calls_of(group: str) -> set[str]:
    """The system calls of one of systemd's groups."""
    text = subprocess.run(
        ["systemd-analyze", "syscall-filter", group], text=True, capture_output=True, check=True
    ).stdout
    found: set[str] = set()
    for line in (line.strip() for line in text.splitlines()[1:]):
        if line.startswith("@"):
            found |= calls_of(line)
        elif line and not line.startswith("#"):
            found.add(line)
    return found


def confine(role: str) -> Callable[[], None]:
    """A function to call between fork and exec that applies this unit's restrictions."""
    try:
        library = ctypes.CDLL("libseccomp.so.2")
    except OSError:
        pytest.skip("needs libseccomp")
    library.seccomp_init.restype = ctypes.c_void_p
    permitted = [c for group in setting(role, "SystemCallFilter") for c in calls_of(group)]
    libc = ctypes.CDLL(None, use_errno=True)
    (given,) = setting(role, "CapabilityBoundingSet")
    assert given == ""
    limits = []
    for key, (number, same) in LIMITS.items():
        for value in setting(role, key):
            limit = resource.RLIM_INFINITY if value == "infinity" else int(value)
            limits.append((number, limit, same))

    def work() -> None:
        kept = set()
        for number, limit, same in limits:
            try:
                resource.setrlimit(number, (limit, limit))
            except ValueError:
                kept.add(same)
        for capability in set(CAPABILITIES) - kept:
            libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
        libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
        rules = ctypes.c_void_p(library.seccomp_init(ERRNO | errno.EPERM))
        for name in permitted:
            number = library.seccomp_syscall_resolve_name(name.encode())
            if number >= 0:  # exists on this architecture
                library.seccomp_rule_add(rules, ALLOW, number, 0)
        if library.seccomp_load(rules):
            raise OSError("seccomp_load")

    return work


@pytest.fixture
def state() -> Iterator[Path]:
    """A folder like the units' StateDirectory, with a path short enough for a socket."""
    with tempfile.TemporaryDirectory(prefix="gfmhil-") as folder:
        yield Path(folder)


def environment(role: str, state: Path) -> dict[str, str]:
    """The unit's Environment=, its directories below ``state``; the loops are compiled already."""
    words = " ".join(x for x in setting(role, "Environment") if "NUMBA_CACHE_DIR" not in x)
    for specifier in ("%t/gfmhil", "%C/gfmhil"):
        words = words.replace(specifier, str(state))
    return {"PATH": os.environ["PATH"], **dict(word.split("=", 1) for word in words.split())}


def test_confinement_is_in_force():
    probe = (
        "import ctypes, re, pathlib;"
        "print(re.search(r'CapEff:\\s*(\\w+)', pathlib.Path('/proc/self/status').read_text())[1]);"
        "print(ctypes.CDLL(None).ptrace(0, 0, 0, 0))"  # PTRACE_TRACEME, normally allowed
    )
    command = [sys.executable, "-c", probe]
    free, confined = (
        subprocess.run(command, preexec_fn=work, capture_output=True, text=True, check=True)
        for work in (None, confine("plant"))
    )
    assert free.stdout.split()[1] == "0"
    capabilities, traced = confined.stdout.split()
    assert int(capabilities, 16) in {0, 1 << CAP_SYS_NICE | 1 << CAP_IPC_LOCK}
    assert traced == "-1"


def test_functions_are_compiled_and_kept_within_it_but_not_without_writable_code(state):
    module = state / "module.py"
    module.write_text(
        "import numba\n"
        "@numba.njit(cache=True)\n"
        "def one_more(x):\n    return x + 1\n"
        "print(one_more(1))\n"
    )
    where = {**os.environ, "NUMBA_CACHE_DIR": str(state / "numba")}
    work = confine("controller")
    command = [sys.executable, str(module)]
    done = subprocess.run(command, preexec_fn=work, capture_output=True, text=True, env=where)
    assert (done.stdout, done.returncode) == ("2\n", 0), done.stderr
    assert list((state / "numba").rglob("*.nbc"))
    if ctypes.CDLL(None).prctl(PR_GET_MDWE, 0, 0, 0, 0) < 0:
        return  # a kernel before 6.3 cannot show why MemoryDenyWriteExecute= is left out

    def strict() -> None:
        work()
        ctypes.CDLL(None).prctl(PR_SET_MDWE, 1, 0, 0, 0)

    refused = subprocess.run(command, preexec_fn=strict, capture_output=True, text=True, env=where)
    assert "cannot allocate executable memory" in refused.stderr


def test_roles_run_in_real_time_within_what_their_units_leave(state):
    scenario = state / "rig.toml"
    content: dict[str, Any] = {
        "title": "rig",
        "duration": 0.1,
        "mode": "realtime",
        "late_policy": {"hold": 1_000_000},  # a busy machine is late; that is not tested here
        "link": {
            "type": "zmq",
            "endpoint": f"ipc://{state}/rig",
            "peer_timeout_s": 60.0,
            "start_timeout_s": 500.0,
        },
    }
    scenario.write_text(toml_text(content))
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "gfm_hil", role, str(scenario), "--quiet", "--out", role],
            cwd=state, env=environment(role, state), preexec_fn=confine(role),
            stderr=subprocess.PIPE, text=True,
        )
        for role in ROLES
    ]  # fmt: skip
    try:
        for role, process in zip(ROLES, processes, strict=True):
            _, err = process.communicate(timeout=550)
            assert (process.returncode, err) == (0, ""), role
    finally:
        for process in processes:
            process.kill()
            process.wait()
    for role in ROLES:
        events = [json.loads(x) for x in (state / role / "events.jsonl").read_text().splitlines()]
        (got,) = [event for event in events if event["event"] == "scheduling"]
        assert got["policy"] == "fifo 50"
        assert got["memory_locked"] is True


def test_the_bench_and_a_stream_beside_it_run_within_what_their_units_leave(state):
    content: dict[str, Any] = {
        "title": "rig", "duration": 600.0, "mode": "realtime", "law": "vsg-2-tuned",
        "T_s": 1e-3,  # at 0.1 ms the loops' SCHED_FIFO leaves little of two processors to others
        "after_trip": "wait", "late_policy": {"hold": 10_000_000},
        "link": {"type": "shm", "peer_timeout_s": 60.0, "start_timeout_s": 500.0},
    }  # fmt: skip
    (state / "rig.toml").write_text(toml_text(content))
    (state / "rig").symlink_to(state / "runs/rig-1")  # as ExecStartPre= does

    def begin(service: str, *words: str) -> subprocess.Popen[str]:
        # systemd watches the process that it started, but accepts its children's messages too
        told = {"NOTIFY_SOCKET": f"{state}/notify", "WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}
        return subprocess.Popen(
            [sys.executable, "-m", "gfm_hil", *words], cwd=state, text=True,
            env={**environment(service, state), **(told if service == "bench" else {})},
            preexec_fn=confine(service), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
        zmq.Context() as context,
        context.socket(zmq.SUB) as subscriber,
    ):
        manager.bind(f"{state}/notify")
        manager.settimeout(500.0)

        def wait_for(line: str) -> None:
            while line not in manager.recv(4096).decode().split("\n"):
                pass

        bench = begin("bench", "run", "rig.toml", "--quiet", "--no-figures", "--out", "runs/rig-1")
        stream = None
        try:
            wait_for("READY=1")
            wait_for("WATCHDOG=1")
            stream = begin("stream", "stream", str(state / "rig"), "--port", "0")
            assert stream.stdout is not None
            subscriber.subscribe(b"")
            subscriber.connect(stream.stdout.readline().split()[1])
            assert subscriber.poll(60_000)
            assert "tick" in json.loads(subscriber.recv_multipart()[1])
            bench.terminate()  # KillMode=mixed: the bench stops the sides
            _, error = bench.communicate(timeout=300)
            assert (bench.returncode, error) == (130, "")
            _, said = stream.communicate(timeout=60)
            assert stream.returncode == 0
            assert said.endswith(" ticks sent on\n")
        finally:
            for process in (bench, stream):
                if process is not None:
                    process.kill()
                    process.wait()
