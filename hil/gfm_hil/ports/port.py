"""The life of every port beside a run: options, address, encryption, begin and end; and the start
of one, a gfmhil command of its own, beside a run that this process is about to start."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import socket
import ssl
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

from gfm_hil.core.errors import UserError, need
from gfm_hil.core.stopping import Interrupt
from gfm_hil.core.supervised import PAUSE_S, report
from gfm_hil.engine.announcement import not_running, running_roles
from gfm_hil.links.zeromq.options import beyond_loopback
from gfm_hil.ports import PORTS, make_port
from gfm_hil.ports.commands import Operator
from gfm_hil.recording.live import has_begun
from gfm_hil.recording.run import converters_of
from gfm_runtime.children import guarded

INTERRUPTED = 130
OWN_NUMBER = -1  # the port serves at its own number
_GRACE_S = 5.0
_POLL_S = 0.1
_NICENESS = 5  # the loop comes first, also where it has no real-time rights
_T = TypeVar("_T")


class Refusal(Exception):
    """A request that a port refuses and that changes nothing; ``code`` is its protocol's."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


@contextlib.contextmanager
def refusing(code: int, error: type[Exception]) -> Iterator[None]:
    """Make a refusal, with a code of the protocol, of an error that is raised in this context."""
    try:
        yield
    except error as problem:
        raise Refusal(code, str(problem)) from None


class BesideRun:
    """The run that a port serves; a context manager.

    Args:
        folder: of the run.
        through: name of the port, for the log of the run.
        patient: the run may begin later.
        interrupt: set by Ctrl-C and SIGTERM.
    """

    def __init__(self, folder: Path, through: str, patient: bool, interrupt: Interrupt) -> None:
        self.folder, self._through, self._patient = folder, through, patient
        self._interrupt = interrupt
        self._resources = contextlib.ExitStack()
        self._gone, self._next_check = False, 0.0
        self._places: dict[str, Path] = {}  # once the scenario is there

    def __enter__(self) -> BesideRun:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @property
    def interrupted(self) -> bool:
        """Whether the port is to end at once."""
        return self._interrupt.came

    @property
    def places(self) -> dict[str, Path]:
        """The run folders of a network's converters by their names, or that of one alone as ""."""
        if not self._places and (self.folder / "scenario.toml").is_file():
            names = converters_of(self.folder) or [""]
            self._places = {name: self.folder / name for name in names}
        return self._places or {"": self.folder}

    def over(self) -> bool:
        """Whether no role is alive any more, or the port is to end. What cannot be examined
        is reported, and not over."""
        now = time.monotonic()
        if not self._gone and now >= self._next_check:
            self._next_check = now + _POLL_S
            try:
                self._gone = not any(map(running_roles, self.places.values()))
            except (OSError, UserError) as problem:
                report("the check whether the run goes on", problem)
                self._next_check = now + PAUSE_S
        return self._gone or self.interrupted

    def wait(self, commands: bool = True) -> None:
        """With ``--wait`` wait until the run records or, if it needs them, takes ``commands``.
        Raises KeyboardInterrupt: the port is to end."""
        there = running_roles if commands else has_recording
        while self._patient and not all(map(there, self.places.values())):
            if self.interrupted:
                raise KeyboardInterrupt
            time.sleep(_POLL_S)
        with contextlib.suppress(OSError):
            os.nice(_NICENESS)

    def operator(self, place: Path) -> Operator:
        """An operator of one of the places. Raises UserError: no run is in progress."""
        operator = Operator(place, self._through)
        self._resources.callback(operator.close)
        return operator

    def first(self, ask: Callable[[], _T | None]) -> _T:
        """What ``ask`` returns once it returns something: the handshake may not be over yet. Raises
        UserError: the run is over before."""
        while (found := ask()) is None:
            if self.over():
                raise not_running(self.folder)
            time.sleep(_POLL_S)
        return found

    def serve_until(
        self, work: Coroutine[Any, Any, None], over: Callable[[], bool] | None = None
    ) -> None:
        """Carry out asynchronous work until the run is over, or until ``over()``."""
        over = over or self.over

        async def until() -> None:
            task = asyncio.create_task(work)
            while not task.done() and not over():
                await asyncio.wait([task], timeout=_POLL_S)
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

        asyncio.run(until())


def has_recording(folder: Path) -> bool:
    """Whether there is a recording: of a run that has begun to record, or of a finished one; of a
    network those of all converters."""
    if converters := converters_of(folder):
        return all(has_recording(folder / name) for name in converters)
    return (folder / "signals.npz").is_file() or has_begun(folder)


class OperatorPort(ABC):
    """A way into a run, as a command of its own and as an option of ``gfmhil run``; ``name`` is
    that in the registry."""

    text = ""  # what the command does, for its help, if the registry does not say all of it
    risk: str  # what may happen at an address that others reach
    remedy = "--plain if it shall"  # what permits such an address, in words
    opens: tuple[str, str]  # the option by which a user permits it without encryption, and its help
    # module and package that it needs, who does, and the extra that installs it
    needs: tuple[str, str, str, str] | None = None
    commands = False  # it needs a run that takes commands
    early = 0  # how many lines it prints before the run begins
    stays = False  # it goes on when the run is over, until Ctrl-C
    networks = False  # it serves the runs of all converters of a network
    or_any = False  # without ``--port`` it takes a free one if its own is in use
    socket = socket.SOCK_STREAM  # its kind
    # how it encrypts, once the options are checked; None: plainly
    tls: ssl.SSLContext | None = None

    def __init__(self, name: str) -> None:
        self.name, self.number = name, PORTS[name].number

    def add(self, command: argparse.ArgumentParser) -> None:
        """Add the options that every port has, then its own."""
        said = PORTS[self.name].text
        command.description = self.text or f"{said[0].upper()}{said[1:]}, to its end."
        command.add_argument("folder", type=Path, metavar="RUN", help="the run folder")
        command.add_argument("--wait", action="store_true", help="wait for the run to begin")
        command.add_argument(
            "--host", default="127.0.0.1", help="address to listen at (%(default)s)"
        )
        number = f"{self.number} or else a free one" if self.or_any else str(self.number)
        command.add_argument(
            "--port", type=int, default=None if self.or_any else self.number,
            help=f"to listen at, 0: a free one ({number} by default)",
        )  # fmt: skip
        option, text = self.opens
        command.add_argument(option, action="store_true", dest="open", help=text)
        self.options(command)

    def options(self, command: argparse.ArgumentParser) -> None:  # noqa: B027
        """Add its own options."""

    def instead(self, options: argparse.Namespace) -> bool:
        """Whether the options asked for something else than to serve, which is then done."""
        return False

    def check_needs(self) -> None:
        """Raise UserError if what it needs is not installed."""
        if self.needs is not None:
            need(*self.needs)

    def check(self, options: argparse.Namespace) -> None:
        """See that the options can be, before anything starts. Raises UserError: one cannot, or
        others reach the address though nobody said so."""
        check_number("--port", options.port)
        if self.tls is None and not options.open and beyond_loopback(f"tcp://{options.host}:0"):
            raise UserError(
                f"--host {options.host}: goes beyond this machine, {self.risk}; {self.remedy}"
            )

    @abstractmethod
    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        """Serve until the run is over; returns the exit code. Raises UserError: no run is in
        progress, or the address cannot be used."""

    def call(self, options: argparse.Namespace) -> int:
        """Carry out the command; returns its exit code."""
        if self.instead(options):
            return 0
        self.check_needs()
        self.check(options)
        with (
            Interrupt() as interrupt,
            BesideRun(options.folder, self.name, options.wait, interrupt) as run,
        ):
            return self.serve(run, options)


def say(text: str) -> None:
    """Print a line and flush it, so that a program that waits for it reads it at once."""
    print(text, flush=True)


def check_number(option: str, number: int | None) -> None:
    """Raise UserError for what is no port."""
    if number is not None and not 0 <= number <= 65535:
        raise UserError(f"{option} {number}: must be 0 (any) to 65535")


def make_tls(
    words: str, certificate: Path, key: Path, clients: Path | None = None
) -> ssl.SSLContext:
    """A server's TLS context, with its certificate and key. Raises UserError: a file cannot be
    used.

    Args:
        words: the options, for an error.
        clients: authority that signed a certificate of each client; None: clients need none.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
        if clients is not None:
            context.verify_mode = ssl.CERT_REQUIRED
            context.load_verify_locations(clients)
    except (OSError, ssl.SSLError) as problem:
        raise UserError(f"{words}: {problem}") from None
    return context


@contextlib.contextmanager
def companion(
    name: str, folder: Path, number: int, in_process: bool
) -> Iterator[subprocess.Popen[str] | None]:
    """Start ``gfmhil NAME`` for a run folder that does not exist yet.

    Its output goes to stderr, as stdout may carry JSON. It ends with this process, however that
    ends. Raises UserError: the port is in use, does without a run, or the command ended; it has
    printed why.

    Args:
        name: of the port.
        folder: where the run will be recorded.
        number: to listen at, or ``OWN_NUMBER``.
        in_process: the run takes no commands.

    Yields:
        The process if it stays when the run is over, else None.
    """
    port = make_port(name)
    port.check_needs()
    if in_process and port.commands:
        raise UserError(f"--{name}: a run in process takes no commands; choose --link")
    if number == OWN_NUMBER and not port.or_any:
        number = port.number
    argv = [sys.executable, "-P", "-m", "gfm_hil", name, str(folder.absolute()), "--wait"]
    if number != OWN_NUMBER:
        _check_free(port, number)
        argv += ["--port", str(number)]
    # own session: the first Ctrl-C is for the run
    process = subprocess.Popen(
        guarded(argv), stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    out = process.stdout
    assert out is not None

    def pass_on_line() -> str:
        line = out.readline()
        print(line, end="", file=sys.stderr, flush=True)
        return line

    def pass_on() -> None:
        while pass_on_line():
            pass

    try:
        for _ in range(port.early):
            if not pass_on_line():
                raise UserError(f"--{name}: it ended before the run began")
        threading.Thread(target=pass_on, daemon=True).start()
        yield process if port.stays else None
        if not port.stays:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_GRACE_S)
    finally:
        process.terminate()
        try:
            process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _check_free(port: OperatorPort, number: int) -> None:
    with socket.socket(socket.AF_INET, port.socket) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
        except (OSError, OverflowError) as problem:
            why = getattr(problem, "strerror", None) or problem
            raise UserError(f"--{port.name} {number}: {why}") from None
