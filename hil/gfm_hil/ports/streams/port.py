"""The streams as a port: samples for PlotJuggler, blocks for programs, metrics for Prometheus."""

from __future__ import annotations

import argparse
import contextlib
import sys

from gfm_hil.core.errors import UserError, need
from gfm_hil.ports.port import INTERRUPTED, BesideRun, OperatorPort, check_number, say
from gfm_hil.ports.streams.follow import Follower
from gfm_hil.ports.streams.publish import Publisher


class StreamPort(OperatorPort):
    """The streams of ``gfmhil stream``; they are open before the run begins."""

    text = (
        "Samples for PlotJuggler's ZeroMQ subscriber (JSON) and, at the next port, "
        "every tick in blocks for gfm_hil.ports.streams.BlockReader. Ends with the run."
    )
    risk = "unencrypted"
    opens = "--plain", "listen beyond this machine: everybody there can read, nobody can command"
    early = 2

    def options(self, command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--blocks", type=int, metavar="PORT", help="of blocks; the next by default"
        )
        command.add_argument(
            "--rate", type=float, default=500.0, metavar="HZ", help="samples a second (%(default)g)"
        )
        command.add_argument(
            "--prometheus", type=int, metavar="PORT", help="serve metrics at /metrics, 0: any port"
        )

    def check(self, options: argparse.Namespace) -> None:
        if options.prometheus is not None:
            need("prometheus_client", "prometheus-client", "--prometheus", "metrics")
        check_number("--blocks", options.blocks)
        check_number("--prometheus", options.prometheus)
        if options.port == 65535 and options.blocks is None:
            raise UserError("--port 65535: has no next one, give --blocks")
        if not 0.1 <= options.rate <= 1e6:
            raise UserError(f"--rate {options.rate:g}: must lie in [0.1, 1e6] Hz")
        super().check(options)

    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        follower = None if options.wait else Follower(run.folder)
        following = options.port + 1 if options.port else 0
        blocks = following if options.blocks is None else options.blocks
        with contextlib.ExitStack() as stack:
            publisher = stack.enter_context(Publisher(options.host, options.port, blocks))
            say(f"samples: {publisher.samples} (JSON, {options.rate:g} Hz)")
            say(f"blocks:  {publisher.blocks}")
            collector = None
            if options.prometheus is not None:
                from gfm_hil.ports.streams.prometheus import RunCollector, serve_metrics

                collector = RunCollector()
                metrics = serve_metrics(collector, options.host, options.prometheus)
                say(f"metrics: http://{options.host}:{stack.enter_context(metrics)}/metrics")
            run.wait(commands=False)
            follower = follower or Follower(run.folder)
            if collector is not None:
                collector.follower = follower
            ticks = publisher.follow(follower, options.rate, lambda: run.interrupted)
        print(f"{ticks} ticks sent on", file=sys.stderr)
        return INTERRUPTED if run.interrupted else 0
