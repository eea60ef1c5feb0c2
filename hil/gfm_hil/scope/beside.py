"""A scope beside a run that is about to begin, as a process of its own that outlasts it."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.errors import UserError

_GRACE_S = 2.0


def check_websockets() -> None:
    """Raise UserError if what the scope needs is not installed."""
    if importlib.util.find_spec("websockets") is None:
        raise UserError("the scope needs websockets: pip install 'gfmhil[scope]'")


@contextlib.contextmanager
def scope_beside(folder: Path, port: int | None) -> Iterator[subprocess.Popen[str]]:
    """Start ``gfmhil scope`` for a run folder that is not there yet; ends it in the end.

    Its addresses go to stderr, as stdout may be somebody's JSON. It ends with this process,
    however that ends.

    Args:
        folder: where the run will be recorded.
        port: to serve at; the usual one, or else a free one, if None.

    Raises:
        UserError: the port is in use, or websockets is not installed.
    """
    check_websockets()
    if port:
        _check_free(port)
    command = [sys.executable, "-P", "-m", "gfm_hil", "scope", str(folder), "--wait"]
    command += ["--part", str(os.getpid()), *([] if port is None else ["--port", str(port)])]
    # own session: the first Ctrl-C is for the run
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    threading.Thread(target=_pass_on, args=(process,), daemon=True).start()
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _pass_on(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        print(line, end="", file=sys.stderr, flush=True)


def _check_free(port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as problem:
            raise UserError(f"--scope {port}: {getattr(problem, 'strerror', problem)}") from None
