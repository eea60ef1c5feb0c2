"""A companion of a run: another gfmhil command, such as the scope, as a process of its own."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_runtime.children import guarded

_GRACE_S = 5.0


@contextlib.contextmanager
def companion(
    command: str, folder: Path, port: int | None, ready: int = 0, ends_itself: bool = True
) -> Iterator[subprocess.Popen[str]]:
    """Start ``gfmhil COMMAND`` for a run folder that does not exist yet.

    Its output goes to stderr, as stdout may carry JSON. It ends with this process, however that
    ends.

    Args:
        command: one that takes a folder, ``--wait`` and ``--port``.
        folder: where the run will be recorded.
        port: to serve at; the command's own choice if None.
        ready: how many lines it prints once it serves, which this function waits for; 0 if it
            prints them only when there is a run.
        ends_itself: it ends soon after the run; otherwise this function ends it.

    Raises:
        UserError: the port is taken, or the command ended; it has printed why on stderr.
    """
    if port:
        _check_free(command, port)
    argv = [sys.executable, "-P", "-m", "gfm_hil", command, str(folder.absolute()), "--wait"]
    argv += [] if port is None else ["--port", str(port)]
    # own session: the first Ctrl-C is for the run
    process = subprocess.Popen(
        guarded(argv), stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        for _ in range(ready):
            if not _pass_on_line(process):
                raise UserError(f"--{command}: it ended before the run began")
        threading.Thread(target=_pass_on, args=(process,), daemon=True).start()
        yield process
        if ends_itself:
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


def _check_free(command: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as problem:
            why = getattr(problem, "strerror", None) or problem
            raise UserError(f"--{command} {port}: {why}") from None
