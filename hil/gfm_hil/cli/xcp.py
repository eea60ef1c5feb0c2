"""gfmhil xcp: serve a run that is going on to a calibration tool."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text

PORT = 5555
_LOOK_S = 0.1


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Serve a run that is going on to a calibration tool, as an XCP slave on UDP or CAN FD, to "
        "its end."
    )
    command.add_argument("folder", type=Path, metavar="RUN", help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s)")
    command.add_argument("--port", type=int, default=PORT, help="0: a free one (%(default)s)")
    command.add_argument(
        "--can", metavar="CHANNEL", help="listen on this CAN FD bus instead, e.g. can0"
    )
    command.add_argument(
        "--interface", default="socketcan", help="python-can's name of its driver (%(default)s)"
    )
    command.add_argument(
        "--ids", metavar="MASTER,SLAVE", help="identifiers of the frames on the bus (0x7f0,0x7f1)"
    )
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
    from gfm_hil.engine.announcement import present
    from gfm_hil.ports.xcp.lines import CanFd, Line, Udp
    from gfm_hil.ports.xcp.serve import live_a2l, serve
    from gfm_hil.recording.live import begun

    line: Line = Udp(options.host, options.port, options.plain)
    if options.can is not None:
        line = CanFd(options.interface, options.can, *_identifiers(options.ids))
    # a role records a moment before it announces its command server
    while options.wait and not (begun(options.folder) and present(options.folder)):
        time.sleep(_LOOK_S)
    if options.a2l is not None:
        write_text(options.a2l, live_a2l(options.folder, line))
        return 0
    serve(options.folder, line, options.write, lambda text: print(text, flush=True))
    return 0


def _identifiers(text: str | None) -> list[list[int]]:
    """The identifiers as arguments, none if not given.

    Raises:
        UserError: they are no numbers.
    """
    try:
        return [] if text is None else [[int(part, 0) for part in text.split(",")]]
    except ValueError:
        raise UserError(f"--ids {text}: must be two numbers, as 0x7f0,0x7f1") from None
