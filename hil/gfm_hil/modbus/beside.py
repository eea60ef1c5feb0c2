"""A server beside a run that is about to begin, as a process of its own that ends with it."""

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


def check_pysunspec2() -> None:
    """Raise UserError if what the server needs is not installed."""
    if importlib.util.find_spec("sunspec2") is None:
        raise UserError("the Modbus server needs pysunspec2: pip install 'gfmhil[modbus]'")


@contextlib.contextmanager
def modbus_beside(folder: Path, port: int) -> Iterator[None]:
    """Start ``gfmhil modbus`` on the loopback device for a run folder that is not there yet.

    Its address goes to stderr, as stdout may be somebody's JSON. It ends with the run, and with
    this process, however that ends.

    Args:
        folder: where the run will be recorded.
        port: to serve at.

    Raises:
        UserError: the port is not to be had, or pysunspec2 is not installed.
    """
    check_pysunspec2()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except (OSError, OverflowError) as problem:
            why = getattr(problem, "strerror", None) or problem
            raise UserError(f"--modbus {port}: {why}") from None
    command = [sys.executable, "-P", "-m", "gfm_hil", "modbus", str(folder), "--wait"]
    command += ["--port", str(port), "--part", str(os.getpid())]
    # own session: the first Ctrl-C is for the run
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    threading.Thread(target=_pass_on, args=(process,), daemon=True).start()
    try:
        yield
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_GRACE_S)
    finally:
        process.kill()
        process.wait()


def _pass_on(process: subprocess.Popen[str]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        print(line, end="", file=sys.stderr, flush=True)
