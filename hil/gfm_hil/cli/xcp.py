"""gfmhil xcp: serve a run that is going on to a calibration tool."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from gfm_hil.core.files import write_text

PORT = 5555
_LOOK_S = 0.1


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Serve a run that is going on to a calibration tool, as an XCP slave on UDP, to its end."
    )
    command.add_argument("folder", type=Path, metavar="RUN", help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s)")
    command.add_argument("--port", type=int, default=PORT, help="0: a free one (%(default)s)")
    command.add_argument(
        "--write", action="store_true", help="let tools write references, the law and its gains"
    )
    command.add_argument(
        "--plain", action="store_true",
        help="listen beyond this machine: everybody there can read, and with --write command",
    )  # fmt: skip
    command.add_argument(
        "--a2l", type=Path, metavar="FILE", help="write the A2L file of this run, and end"
    )


def call(options: argparse.Namespace) -> int:
    from gfm_hil.recording.live import begun
    from gfm_hil.xcp.serve import check_address, live_a2l, serve

    check_address(options.host, options.port, options.plain)
    while options.wait and not begun(options.folder):
        time.sleep(_LOOK_S)
    if options.a2l is not None:
        write_text(options.a2l, live_a2l(options.folder, options.host, options.port))
        return 0
    serve(
        options.folder, options.host, options.port, options.write,
        lambda text: print(text, flush=True),
    )  # fmt: skip
    return 0
