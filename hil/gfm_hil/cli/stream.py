"""gfmhil stream: a run that is going on, for PlotJuggler, tools of one's own and Prometheus."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt
from gfm_hil.links.zeromq.options import beyond_loopback

PORT = 9872  # what PlotJuggler's ZeroMQ subscriber connects to unless told otherwise
_LOOK_S = 0.1
_NICENESS = 5  # the loop comes first, also where it has no real-time rights


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Samples for PlotJuggler's ZeroMQ subscriber (JSON) and, at the next port, "
        "every tick in blocks for gfm_hil.ports.streams.BlockReader. Ends with the run."
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument("--port", type=int, default=PORT, help="of samples (%(default)s), 0: any")
    command.add_argument(
        "--blocks", type=int, metavar="PORT", help="of blocks; the next by default"
    )
    command.add_argument(
        "--rate", type=float, default=500.0, metavar="HZ", help="samples a second (%(default)g)"
    )
    command.add_argument(
        "--prometheus", type=int, metavar="PORT", help="serve metrics at /metrics, 0: any port"
    )
    command.add_argument("--host", default="127.0.0.1", help="address to listen on (%(default)s)")
    command.add_argument(
        "--plain", action="store_true",
        help="listen beyond this machine: everybody there can read, nobody can command",
    )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    _check(options)
    from gfm_hil.ports.streams.follow import Follower
    from gfm_hil.ports.streams.publish import Ports, Publisher
    from gfm_hil.recording.live import begun

    follower = None if options.wait and not begun(options.folder) else Follower(options.folder)
    following = options.port + 1 if options.port else 0
    blocks = following if options.blocks is None else options.blocks
    with Interrupt() as interrupt, contextlib.ExitStack() as stack:
        publisher = stack.enter_context(Publisher(Ports(options.host, options.port, blocks)))
        print(f"samples: {publisher.samples} (JSON, {options.rate:g} Hz)")
        print(f"blocks:  {publisher.blocks}")
        collector = None
        if options.prometheus is not None:
            from gfm_hil.ports.streams.prometheus import RunCollector, serve_metrics

            collector = RunCollector()
            port = stack.enter_context(serve_metrics(collector, options.host, options.prometheus))
            print(f"metrics: http://{options.host}:{port}/metrics")
        sys.stdout.flush()
        while follower is None:
            if interrupt.came:
                return 130
            time.sleep(_LOOK_S)
            follower = Follower(options.folder) if begun(options.folder) else None
        if collector is not None:
            collector.follower = follower
        os.nice(_NICENESS)
        ticks = publisher.follow(follower, options.rate, lambda: interrupt.came)
    print(f"{ticks} ticks sent on", file=sys.stderr)
    return 130 if interrupt.came else 0


def _check(options: argparse.Namespace) -> None:
    """See that the options can be.

    Raises:
        UserError: one cannot, or goes beyond this machine without being meant to.
    """
    if options.prometheus is not None and find_spec("prometheus_client") is None:
        raise UserError("--prometheus needs prometheus-client: pip install 'gfmhil[metrics]'")
    for name in ("port", "blocks", "prometheus"):
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
