"""Ports beside a run that this process is about to start: each is a gfmhil command of its own."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.ports import make_port
from gfm_hil.ports.port import OperatorPort
from gfm_runtime.children import guarded

_GRACE_S = 5.0
OWN_NUMBER = -1  # the port serves at its own number


@contextlib.contextmanager
def companion(
    name: str, folder: Path, number: int, in_process: bool
) -> Iterator[subprocess.Popen[str] | None]:
    """Start ``gfmhil NAME`` for a run folder that does not exist yet.

    Its output goes to stderr, as stdout may carry JSON. It ends with this process, however that
    ends.

    Args:
        name: of the port.
        folder: where the run will be recorded.
        number: to listen at, or ``OWN_NUMBER``.
        in_process: the run takes no commands.

    Yields:
        The process if it stays when the run is over, else None.

    Raises:
        UserError: the port is in use, does without a run, or the command ended; it has printed why.
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
    try:
        for _ in range(port.early):
            if not _pass_on_line(process):
                raise UserError(f"--{name}: it ended before the run began")
        threading.Thread(target=_pass_on, args=(process,), daemon=True).start()
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


def _pass_on(process: subprocess.Popen[str]) -> None:
    while _pass_on_line(process):
        pass


def _pass_on_line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    print(line, end="", file=sys.stderr, flush=True)
    return line


def _check_free(port: OperatorPort, number: int) -> None:
    with socket.socket(socket.AF_INET, port.socket) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
        except (OSError, OverflowError) as problem:
            why = getattr(problem, "strerror", None) or problem
            raise UserError(f"--{port.name} {number}: {why}") from None
