"""A program behind a guard: how it ends, what it leaves, what it prints."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gfm_runtime import children
from gfm_runtime.children import GRACE_S, KEPT, Copy, end_now, guarded, module, start

pytestmark = pytest.mark.processes

PATIENCE_S = 60.0
#: ignores SIGTERM, and has a child in a session of its own that does so too
STUBBORN = r"""
import os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
program = os.fork()
if not program:
    os.setsid()
os.write(1, b"%s %d\n" % (b"program" if program else b"forked", os.getpid()))
time.sleep(1000)
"""


def shell(text: str) -> list[str]:
    return ["sh", "-c", text]


def gone(numbers: list[int]) -> bool:
    until = time.monotonic() + PATIENCE_S
    while any(Path(f"/proc/{number}").exists() for number in numbers):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        (shell("echo out; echo err >&2; exit 5"), 5, b"out\nerr\n"),
        (shell("kill -SEGV $$"), -signal.SIGSEGV, b""),
        (shell("kill -KILL $$"), -signal.SIGKILL, b""),
        (["/no/such"], 2, b"gfmhil: /no/such: cannot be started: No such file or directory\n"),
    ],
)
def test_a_guard_ends_as_its_program(command, code, said):
    done = subprocess.run(guarded(command, bounded=True), stdout=subprocess.PIPE, check=False)
    assert (done.returncode, done.stdout) == (code, said)


def test_of_much_it_keeps_the_beginning_and_the_end():
    program = [sys.executable, "-c", "print('first' + 10**7 * '.' + 'last')"]
    said = subprocess.run(guarded(program, bounded=True), stdout=subprocess.PIPE, check=True).stdout
    assert said.startswith(b"first.") and said.endswith(b".last\n")
    note = f"\n… {10**7 + 10 - 2 * KEPT} bytes are left out here …\n".encode()
    assert len(said) == 2 * KEPT + len(note) and note in said


@pytest.mark.parametrize("how", ["program ends", "parent is killed", "SIGTERM"])
def test_nothing_is_left_of_a_stubborn_program(how):
    script = (
        "import os, subprocess, sys; from gfm_runtime.children import guarded\n"
        f"p = subprocess.Popen(guarded([sys.executable, '-c', {STUBBORN!r}]))\n"
        "os.write(1, b'guard %d\\n' % p.pid); p.wait()"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        lines = (parent.stdout.readline().split() for _ in range(3))
        number = {name.decode(): int(text) for name, text in lines}
        victim = {"program ends": number["program"], "parent is killed": parent.pid}
        by = signal.SIGTERM if how == "SIGTERM" else signal.SIGKILL
        os.kill(victim.get(how, number["guard"]), by)
        assert gone([*number.values()])


def test_a_guard_and_a_program_that_are_stopped_end_now():
    command = guarded([sys.executable, "-c", STUBBORN])
    with subprocess.Popen(command, stdout=subprocess.PIPE) as guard:
        assert guard.stdout is not None
        numbers = [guard.pid, *(int(guard.stdout.readline().split()[1]) for _ in range(2))]
        for number in numbers:
            os.kill(number, signal.SIGSTOP)
        end_now(guard)
        guard.wait(GRACE_S + 8)
        assert gone(numbers[1:])


def test_a_program_gets_the_signals_of_its_guard():
    script = (
        "import time\ntry:\n print(1, flush=True); time.sleep(1000)\n"
        "except KeyboardInterrupt:\n print(2)"
    )
    command = guarded([sys.executable, "-c", script])
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        assert process.stdout is not None and process.stdout.readline() == b"1\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.read() == b"2\n"


ENDS = r"""
import os, signal, subprocess, sys, time
print("begins", flush=True)
how = sys.argv[1]
if how == "raises":
    raise RuntimeError("why")
elif how == "exits":
    sys.exit(5)
elif how == "says why":
    sys.exit("why")
elif how == "is killed":
    os.kill(os.getpid(), signal.SIGKILL)
elif how == "leaves a program":
    subprocess.Popen([sys.executable, "-c", sys.argv[2]])
    time.sleep(1)
elif how == "is interrupted":
    os.kill(os.getppid(), signal.SIGINT)
    try:
        time.sleep(1000)
    except KeyboardInterrupt:
        sys.exit("interrupted")
"""


@pytest.mark.parametrize("anew", [False, True], ids=["copy", "new"])
@pytest.mark.parametrize(
    ("how", "code", "last"),
    [
        ("returns", 0, "begins"),
        ("raises", 1, "RuntimeError: why"),
        ("exits", 5, "begins"),
        ("says why", 1, "why"),
        ("is killed", -signal.SIGKILL, "begins"),
        ("is interrupted", 1, "interrupted"),
        ("leaves a program", 0, "forked"),
    ],
)
def test_a_module_of_ours_ends_as_a_program(how, code, last, anew, tmp_path, monkeypatch):
    """Whether it is a copy of this process, or a new interpreter."""
    (tmp_path / "gfm_ends.py").write_text(ENDS, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(children, "may_fork", lambda: not anew)
    log = tmp_path / "log"
    with log.open("w") as output:
        program = start(module("gfm_ends", how, STUBBORN), output.fileno())
    assert isinstance(program, Copy) is not anew
    assert program.wait() == program.poll() == program.returncode == code
    program.send_signal(signal.SIGKILL)  # has no effect: the program has ended
    said = log.read_text().split("\n")
    assert said[0] == "begins" and said[-2].startswith(last)
    assert gone([int(line.split()[1]) for line in said if line.startswith(("program", "forked"))])


def test_a_process_with_another_thread_is_not_copied():
    script = """
import threading
from gfm_runtime.children import may_fork
print(may_fork())
threading.Thread(target=threading.Event().wait, daemon=True).start()
print(may_fork())"""
    said = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, check=True).stdout
    assert said == b"True\nFalse\n"
