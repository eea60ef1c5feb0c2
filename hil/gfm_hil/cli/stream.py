"""gfmhil stream: a run that is going on, for PlotJuggler, tools of one's own and Prometheus."""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

from gfm_hil.errors import UserError
from gfm_hil.links.zeromq.reach import beyond_loopback
from gfm_hil.stopping import Interrupt

PORT = 9872  # what PlotJuggler's ZeroMQ subscriber connects to unless told otherwise
_LOOK_S = 0.1
_NICENESS = 5  # the loop comes first, also where it has no real-time rights


def add(commands: Any) -> None:
    """Add the command to the parser."""
    command = commands.add_parser(
        "stream",
        help="send on what a run records while it goes on: PlotJuggler, own tools, Prometheus",
        description="Samples for PlotJuggler's ZeroMQ subscriber (JSON) and, at the next port, "
        "every tick in blocks for gfm_hil.telemetry.BlockReader. Ends with the run.",
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument("--port", type=int, default=PORT, help="of samples (%(default)s), 0: any")
    command.add_argument(
        "--blocks", type=int, metavar="PORT", help="of blocks; the next by default"
    )
    command.add_argument(
        "--rate", type=float, default=1000.0, metavar="HZ", help="samples a second (%(default)g)"
    )
    command.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s)")
    command.add_argument(
        "--plain", action="store_true",
        help="listen beyond this machine: everybody there can read, nobody can command",
    )  # fmt: skip
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Carry it out; returns the exit code."""
    _check(options)
    from gfm_hil.telemetry.follow import Follower, begun
    from gfm_hil.telemetry.publish import Ports, publish

    following = options.port + 1 if options.port else 0
    ports = Ports(
        options.host, options.port, following if options.blocks is None else options.blocks
    )

    def ready(samples: str, blocks: str) -> None:
        print(f"samples: {samples} (JSON, {options.rate:g} Hz)\nblocks:  {blocks}", flush=True)

    with Interrupt() as interrupt:
        while options.wait and not begun(options.folder) and not interrupt.came:
            time.sleep(_LOOK_S)
        if interrupt.came:
            return 130
        os.nice(_NICENESS)
        ticks = publish(
            Follower(options.folder), ports, options.rate, ready, lambda: interrupt.came
        )
    print(f"{ticks} ticks sent on", file=sys.stderr)
    return 130 if interrupt.came else 0


def _check(options: argparse.Namespace) -> None:
    """See that the options can be.

    Raises:
        UserError: one cannot, or goes beyond this machine without being meant to.
    """
    for name in ("port", "blocks"):
        port = getattr(options, name)
        if port is not None and not 0 <= port <= 65535:
            raise UserError(f"--{name} {port}: must be 0 (any) to 65535")
    if options.port == 65535 and options.blocks is None:
        raise UserError("--port 65535: has no next one, give --blocks")
    if not 0.1 <= options.rate <= 1e6:
        raise UserError(f"--rate {options.rate:g}: must lie in [0.1, 1e6] Hz")
    if not options.plain and beyond_loopback(f"tcp://{options.host}:0"):
        raise UserError(
            f"--host {options.host}: goes beyond this machine, unencrypted; --plain if it shall"
        )
