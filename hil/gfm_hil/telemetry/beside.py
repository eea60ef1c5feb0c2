"""A stream beside a run that is about to begin, as a process of its own that ends with it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.errors import UserError

_GRACE_S = 5.0
_LINES = 2  # that it says once it is ready


@contextlib.contextmanager
def stream_beside(folder: Path, port: int) -> Iterator[None]:
    """Start ``gfmhil stream`` for a run folder that is not there yet.

    Its addresses go to stderr, as stdout may be somebody's JSON. It ends with the run, and with
    this process, however that ends.

    Args:
        folder: where the run will be recorded.
        port: of samples.

    Raises:
        UserError: it cannot listen there.
    """
    command = [sys.executable, "-P", "-m", "gfm_hil", "stream", str(folder), "--wait"]
    command += ["--port", str(port), "--part", str(os.getpid())]
    pipe = subprocess.PIPE
    # own session: the first Ctrl-C is for the run
    with subprocess.Popen(
        command, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        said = [process.stdout.readline() for _ in range(_LINES)]
        if not all(said):
            _, error = process.communicate()
            raise UserError(error.strip().removeprefix("gfmhil: "))
        print("".join(said), end="", file=sys.stderr, flush=True)
        try:
            yield
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=_GRACE_S)
        finally:
            process.kill()
