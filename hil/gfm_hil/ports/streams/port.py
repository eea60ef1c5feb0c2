"""The streams as a port: samples for PlotJuggler, blocks for programs, metrics for Prometheus."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from gfm_hil.core.errors import UserError, need
from gfm_hil.core.identity import address
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.core.supervised import attempt
from gfm_hil.engine.announcement import not_running
from gfm_hil.ports.port import INTERRUPTED, BesideRun, OperatorPort, check_number, say
from gfm_hil.ports.streams.messages import ROOM, NewRows, Sampler, block_messages
from gfm_hil.recording.live import LiveRun, has_begun
from gfm_hil.recording.timing import ROUND_TRIP, SLACK, count_misses

_LAST = 1  # newest rows not read yet: a tick's last time is written after it counts as done
_POLL_S = 0.02
_LINGER_MS = 500  # to send the last messages
_LONGEST = 256  # bytes of a subscription; ours have 17 and the name of a converter
_WAITING = 100  # queued subscription messages per subscriber

#: of Prometheus: label, if any, and meaning of each metric
METRICS = {
    "gfmhil_ticks_total": ("role", "ticks recorded"),
    "gfmhil_misses_total": ("", "ticks without a fresh u at the plant"),
    "gfmhil_slack_seconds": ("quantile", f"{SLACK.meaning}; in real time"),
    "gfmhil_round_trip_seconds": ("quantile", ROUND_TRIP.meaning),
    "gfmhil_state": ("state", "1 for the state of the controller, 0 for others"),
    "gfmhil_law_info": ("law", "the law in force"),
    "gfmhil_reason_info": ("reason", "why the controller is in SAFE"),
    "gfmhil_trip_info": ("trip", "what has tripped"),
}


class Follower:
    """Reads what a run records from now on. Raises UserError: it is not a run folder, or the run is
    over.

    Args:
        folder: of the run.
        converter: whose it is, in a network.

    Attributes:
        run: all that it has recorded.
        over: nothing will be recorded any more.
    """

    def __init__(self, folder: Path, converter: str = "") -> None:
        if (folder / "summary.json").is_file():
            raise UserError(f"{folder}: the run is over, see gfmhil export")
        if not has_begun(folder):
            raise UserError(f"{not_running(folder)}; --wait waits for one")
        self.folder, self.converter, self.run = folder, converter, LiveRun(folder)
        self.T_s = self.run.T_s
        self._next = {role: self.run.done(role) for role in ROLES}
        self.over = False

    def news(self) -> list[NewRows]:
        """Rows recorded since the last call that returned; afterwards ``over`` says whether these
        were the last. Raises OSError: the recording cannot be read now; the next call returns its
        rows."""
        over = not (self.folder / "parts").is_dir()  # the parts were merged and removed
        found = []
        for role, part in self.run.parts.items():
            first, done = self._next[role], self.run.done(role) - (0 if over else _LAST)
            if done > first:
                rows = part.signals[first:done], part.times[first:done]
                found.append(NewRows(role, first, *rows, self.converter))
        self.over = over
        self._next |= {rows.role: rows.first + len(rows.signals) for rows in found}
        return found

    def misses_before(self) -> int:
        """Number of misses before the rows that the next call of ``news`` returns."""
        return count_misses(self.run.columns, self._next["plant"])


class Publisher:
    """Both sockets, bound; use as a context manager. Raises UserError: a port cannot be bound.

    Args:
        host: address to listen at.
        samples, blocks: ports, 0: a free one.

    Attributes:
        samples, blocks: the endpoints.
    """

    def __init__(self, host: str, samples: int, blocks: int) -> None:
        self._context = zmq.Context()
        try:
            self._samples = _bind(self._context, host, samples, "--port")
            self._blocks = _bind(self._context, host, blocks, "--blocks")
        except UserError:
            self._context.destroy(linger=0)
            raise
        self.samples, self.blocks = (
            socket.get_string(zmq.LAST_ENDPOINT) for socket in (self._samples, self._blocks)
        )

    def __enter__(self) -> Publisher:
        return self

    def __exit__(self, *_: object) -> None:
        self._context.destroy(linger=_LINGER_MS)

    def follow(
        self, followers: Sequence[Follower], rate: float, stopped: Callable[[], bool]
    ) -> int:
        """Send the rows of a run, or of all converters of a network, and of each ``rate`` samples
        per second, until all end or ``stopped()``; returns how many ticks of the plant (without a
        plant: of the controller) were sent in all."""
        samplers = {one: Sampler(one.T_s, rate, one.misses_before()) for one in followers}
        count: dict[Role, int] = dict.fromkeys(ROLES, 0)
        looked = time.monotonic()

        def look() -> None:
            nonlocal looked
            before, looked = looked, time.monotonic()
            for follower in (one for one in followers if not one.over):
                for rows in follower.news():
                    count[rows.role] += len(rows.signals)
                    for message in samplers[follower].messages(rows, looked - before):
                        self._samples.send_multipart(message)
                    for message in block_messages(rows):
                        self._blocks.send_multipart(message)

        while not all(one.over for one in followers) and not stopped():
            time.sleep(_POLL_S)
            attempt("the stream's poll of the run", look)
        return count["plant"] or count["controller"]


def _followers(run: BesideRun) -> list[Follower]:
    """Of all places of a run. Raises UserError: as ``Follower``."""
    return [Follower(place, name) for name, place in run.places.items()]


def _bind(
    context: zmq.Context[zmq.Socket[bytes]], host: str, port: int, option: str
) -> zmq.Socket[bytes]:
    socket = context.socket(zmq.PUB)
    socket.set(zmq.MAXMSGSIZE, _LONGEST)
    socket.set(zmq.RCVHWM, _WAITING)
    socket.set(zmq.SNDHWM, ROOM)
    where = f"tcp://{address((host, port or '*'))}"
    try:
        socket.set(zmq.IPV6, int(":" in host))
        socket.bind(where)
    except zmq.ZMQError as problem:
        raise UserError(f"{option} {port}: {where}: {zmq.strerror(problem.errno or 0)}") from None
    return socket


class StreamPort(OperatorPort):
    """The streams of ``gfmhil stream``; they are open before the run begins."""

    text = (
        "Samples for PlotJuggler's ZeroMQ subscriber (JSON) and, at the next port, "
        "every tick in blocks for gfm_hil.ports.streams.BlockReader. Ends with the run."
    )
    risk = "unencrypted"
    opens = "--plain", "listen beyond this machine: everybody there can read, nobody can command"
    early = 2
    networks = True

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
        followers = [] if options.wait else _followers(run)
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
            followers = followers or _followers(run)
            if collector is not None:
                collector.followers = followers
            ticks = publisher.follow(followers, options.rate, lambda: run.interrupted)
        print(f"{ticks} ticks sent on", file=sys.stderr)
        return INTERRUPTED if run.interrupted else 0
