"""Children that end with their parent, however it ends.

A process of ours calls ``end_with_parent``. Any other program runs behind a guard, see ``guarded``:
this file as a program of its own, a process between the parent and that program. The kernel tells
it when its parent ends, and gives it whatever the program has started and left behind.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # a guard starts quickly without it
    import subprocess

GRACE_S = 2.0
"""Time in which a program behind a guard may end by itself once its parent has ended, s."""
KEPT = 256 * 1024
"""Bytes that a guard keeps of the beginning and of the end of what its program prints."""

_END_NOW = signal.SIGUSR1  # has a guard kill its program and all that it has started
_SET_DEATH_SIGNAL, _SET_CHILD_SUBREAPER = 1, 36  # of prctl(2)
_PASSED_ON = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def end_with_parent(parent: int | None = None, by: signal.Signals = signal.SIGTERM) -> None:
    """Have Linux send this process a signal when its parent is gone, even if it was killed.

    ``parent`` is its process id, to check whether it has already ended.
    """
    _prctl(_SET_DEATH_SIGNAL, by)
    if parent not in (None, os.getppid()):
        os.kill(os.getpid(), by)


def guarded(command: Sequence[str], bounded: bool = False) -> list[str]:
    """The command that runs a program behind a guard.

    The guard passes SIGINT, SIGTERM and SIGHUP on, and ends as the program does. It kills what the
    program has started and left: when the program has ended, and ``GRACE_S`` after SIGTERM or after
    the end of this process.

    Args:
        command: the program with its arguments.
        bounded: what it prints, on stdout and stderr, goes to stdout, and of much only ``KEPT``
            bytes of the beginning and of the end.
    """
    words = [sys.executable, "-IS", str(Path(__file__).absolute()), str(os.getpid())]
    return [*words, "bounded" if bounded else "", *command]


def end_now(guard: subprocess.Popen[Any]) -> None:
    """Have a guard kill its program and all that it has started, also while either is stopped."""
    guard.send_signal(_END_NOW)
    guard.send_signal(signal.SIGCONT)


def _prctl(*arguments: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(*arguments)


def _guard(parent: int, bounded: bool, command: list[str]) -> int:
    """Run the command; returns how it ended, as ``os.waitstatus_to_exitcode``."""
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    for number in (signal.SIGCHLD, _END_NOW, *_PASSED_ON):
        if signal.getsignal(number) != signal.SIG_IGN or number != signal.SIGHUP:  # nohup set it
            signal.signal(number, lambda *_: None)
    _prctl(_SET_CHILD_SUBREAPER, 1)
    end_with_parent(parent)
    output, its_output = os.pipe()
    os.set_blocking(output, False)
    program = _started(command, its_output if bounded else None)
    os.close(its_output)
    said, end, kill_at = _Output(), None, float("inf")
    sources = [woken, output]
    while end is None:
        wait = None if kill_at == float("inf") else max(0.0, kill_at - time.monotonic())
        ready = select.select(sources, [], [], wait)[0]
        if output in ready and not said.read(output):
            sources.remove(output)
        for came in os.read(woken, 256) if woken in ready else b"":
            if came in _PASSED_ON:
                os.kill(program, came)
            if came == signal.SIGTERM:
                kill_at = min(kill_at, time.monotonic() + GRACE_S)
            elif came == _END_NOW:
                kill_at = 0.0
        if time.monotonic() >= kill_at:
            os.kill(program, signal.SIGKILL)
        end = _reaped(program)
    _kill_all()
    while said.read(output):
        pass
    said.close()
    return end


def _started(command: list[str], output: int | None) -> int:
    """Start the program as a child that ends with this process; returns its process id."""
    guard = os.getpid()
    program = os.fork()
    if program:
        return program
    try:
        end_with_parent(guard, signal.SIGKILL)
        for number in (signal.SIGINT, signal.SIGPIPE, signal.SIGXFSZ):  # as for a new program
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
        if output is not None:
            os.dup2(output, 1)
            os.dup2(output, 2)
        os.execvp(command[0], command)
    except OSError as problem:
        os.write(2, f"gfmhil: {command[0]}: cannot be started: {problem.strerror}\n".encode())
    os._exit(2)


def _reaped(program: int) -> int | None:
    """Take leave of children that have ended; how the program did, None if it has not."""
    end = None
    with contextlib.suppress(ChildProcessError):
        while (found := os.waitpid(-1, os.WNOHANG))[0]:
            if found[0] == program:
                end = os.waitstatus_to_exitcode(found[1])
    return end


def _kill_all() -> None:
    """Kill all children; their children become ours when they have ended."""
    with contextlib.suppress(ChildProcessError):
        while True:
            for child in _children():
                os.kill(child, signal.SIGKILL)
            os.waitpid(-1, 0)


def _children() -> Iterator[int]:
    for place in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            if int(place.read_bytes().rpartition(b")")[2].split()[1]) == os.getpid():
                yield int(place.parent.name)


class _Output:
    """What the program has printed: the beginning goes to stdout at once, the end at the end."""

    def __init__(self) -> None:
        self._room, self._end, self._left_out = KEPT, b"", 0

    def read(self, source: int) -> bool:
        """Take what is there; whether there may be more."""
        try:
            data = os.read(source, 65536)
        except BlockingIOError:
            return False
        self._write(data[: self._room])
        self._end += data[self._room :]
        self._room = max(0, self._room - len(data))
        over = max(0, len(self._end) - KEPT)
        self._left_out, self._end = self._left_out + over, self._end[over:]
        return bool(data)

    def close(self) -> None:
        """Write the end."""
        if self._left_out:
            self._write(f"\n… {self._left_out} bytes are left out here …\n".encode())
        self._write(self._end)

    def _write(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # a full disk, or nobody reads it any more
            while data:
                data = data[os.write(1, data) :]


if __name__ == "__main__":
    ended = _guard(int(sys.argv[1]), bool(sys.argv[2]), sys.argv[3:])
    if ended < 0:  # as the program: by that signal, but without a dump of this process
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if -ended not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-ended, signal.SIG_DFL)
        os.kill(os.getpid(), -ended)
    sys.exit(ended)
