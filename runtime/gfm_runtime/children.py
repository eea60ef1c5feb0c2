"""Children that end with their parent, however it ends.

A process of ours calls ``end_with_parent``. Any other program runs behind a guard, see ``guarded``:
this file as a program of its own, a process between the parent and that program. The kernel tells
it when its parent ends, and gives it whatever the program has started and left behind.

``start`` starts such a program. One of ours, ``python -m``, goes on in a copy of this process where
that is safe, with all that is imported and compiled here: that takes milliseconds, and a second by
a new interpreter.
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
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:  # a guard starts quickly without it
    import subprocess

GRACE_S = 2.0
"""Time in which a program behind a guard may end by itself once its parent has ended, s."""
KEPT = 256 * 1024
"""Bytes that a guard keeps of the beginning and of the end of what its program prints."""

_END_NOW = signal.SIGUSR1  # has a guard kill its program and all that it has started
_SET_DEATH_SIGNAL, _SET_NAME, _SET_CHILD_SUBREAPER = 1, 15, 36  # of prctl(2)
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


def name_process(name: str) -> None:
    """Give this process the name that top and ps show, of at most 15 characters."""
    _prctl(_SET_NAME, name.encode())


def module(name: str, *words: str) -> list[str]:
    """The command of one of our modules as a program. A file of the folder in which the operator
    is must not stand in for a module, hence -P."""
    return [*_MODULE, name, *words]


_MODULE = (sys.executable, "-P", "-m")


def start(command: Sequence[str], output: int) -> subprocess.Popen[bytes] | Copy:
    """Start a program behind a guard, in a session of its own: a Ctrl-C in the terminal reaches
    this process alone.

    Args:
        command: the program with its arguments; see ``module``.
        output: open file for what it prints, bounded as of ``guarded``.
    """
    from subprocess import Popen

    if tuple(command[: len(_MODULE)]) == _MODULE and may_fork():
        return Copy(command[len(_MODULE) :], output)
    words = guarded(command, bounded=True)
    return Popen(words, stdout=output, stderr=output, start_new_session=True)


def may_fork() -> bool:
    """Whether a copy of this process works: a lock that another thread has would never be released
    in it. The thread of a progress bar only writes to the terminal, which a copy does not."""
    import threading

    if sys.platform != "linux":
        return False
    others = (t for t in threading.enumerate() if type(t).__module__ != "rich.live")
    return [*others] == [threading.main_thread()]


class Copy:
    """A module of ours as a program behind a guard, both of them copies of this process; with the
    methods of ``subprocess.Popen`` that our callers need. Arguments as of ``start``, the command
    without the interpreter."""

    def __init__(self, words: Sequence[str], output: int) -> None:
        import warnings

        parent = os.getpid()
        self.returncode: Any = None
        for stream in sys.stdout, sys.stderr:  # what waits there, the copy would write once more
            if stream is not None:
                stream.flush()
        with warnings.catch_warnings(action="ignore"):  # of threads, see may_fork
            self.pid = os.fork()
        if self.pid:
            return
        with _no_return():
            name_process("gfm guard")
            os.setsid()
            _take_over(output)
            _end_as(_guard(parent, True, lambda: _run_module(*words)))

    def poll(self) -> int | None:
        """How it ended, as ``os.waitstatus_to_exitcode``; None if it has not."""
        return self._reap(os.WNOHANG)

    def wait(self) -> int:
        """Wait until it has ended; returns how."""
        code = self._reap(0)
        assert code is not None
        return code

    def _reap(self, how: int) -> int | None:
        if self.returncode is None:
            process, status = os.waitpid(self.pid, how)
            if process:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it a signal while it lives."""
        if self.poll() is None:
            os.kill(self.pid, number)


def end_now(guard: subprocess.Popen[Any] | Copy) -> None:
    """Have a guard kill its program and all that it has started, also while either is stopped."""
    guard.send_signal(_END_NOW)
    guard.send_signal(signal.SIGCONT)


def _prctl(*arguments: int | bytes) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(*arguments)


@contextlib.contextmanager
def _no_return() -> Iterator[None]:
    """End a copy of this process after a block, without what its parent does at an exit."""
    code = 1
    try:
        yield
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        if code and not isinstance(stop.code, int):
            print(stop.code, file=sys.stderr)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        for stream in sys.stdout, sys.stderr:
            with contextlib.suppress(OSError):  # a full disk
                stream.flush()
        os._exit(code)


def _take_over(output: int) -> None:
    """Be no longer the process of which this one is a copy: print to the output, let go of all its
    files, and leave signals to the system."""
    os.dup2(output, 1)
    os.dup2(output, 2)
    nothing = os.open(os.devnull, os.O_RDWR)
    for file in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        if file > 2:  # not closed: an object here that closes it later would close another file
            os.dup2(nothing, file)
    sys.stdout = os.fdopen(1, "w")
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace")
    signal.pthread_sigmask(signal.SIG_SETMASK, [])
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):
            signal.signal(number, signal.SIG_DFL)


def _run_module(name: str, *words: str) -> NoReturn:
    """Run one of our modules as a program in this process, which is a copy."""
    import runpy

    with _no_return():
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv[1:] = words
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    raise AssertionError


def _guard(parent: int, bounded: bool, program: Callable[[], NoReturn]) -> int:
    """Run the program; returns how it ended, as ``os.waitstatus_to_exitcode``."""
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
    child = _forked(program, its_output if bounded else None)
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
                os.kill(child, came)
            if came == signal.SIGTERM:
                kill_at = min(kill_at, time.monotonic() + GRACE_S)
            elif came == _END_NOW:
                kill_at = 0.0
        if time.monotonic() >= kill_at:
            os.kill(child, signal.SIGKILL)
        end = _reaped(child)
    _kill_all()
    while said.read(output):
        pass
    said.close()
    return end


def _forked(program: Callable[[], NoReturn], output: int | None) -> int:
    """Run the program as a child that ends with this process; returns its process id."""
    guard = os.getpid()
    if child := os.fork():
        return child
    with _no_return():
        end_with_parent(guard, signal.SIGKILL)
        signal.set_wakeup_fd(-1)
        for number in (signal.SIGCHLD, _END_NOW, *_PASSED_ON):
            if signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, signal.SIG_DFL)
        if output is not None:
            os.dup2(output, 1)
            os.dup2(output, 2)
        program()
    raise AssertionError


def _executed(command: list[str]) -> NoReturn:
    """Become another program."""
    try:
        for number in (signal.SIGPIPE, signal.SIGXFSZ):  # which Python ignores
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
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


def _end_as(ended: int) -> NoReturn:
    """End this process as its program has: by that signal, but without a dump of this process."""
    if ended < 0:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if -ended not in (signal.SIGKILL, signal.SIGSTOP):
            signal.signal(-ended, signal.SIG_DFL)
        os.kill(os.getpid(), -ended)
    sys.exit(ended)


if __name__ == "__main__":
    _end_as(_guard(int(sys.argv[1]), bool(sys.argv[2]), lambda: _executed(sys.argv[3:])))
