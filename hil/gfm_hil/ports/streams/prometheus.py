"""Prometheus metrics of a run, computed from the recording at each scrape."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from socketserver import BaseServer, ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gfm_hil.core.errors import UserError
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.streams.follow import Follower
from gfm_hil.ports.streams.metrics import METRICS
from gfm_hil.recording.timing import ROUND_TRIP, SLACK, DurationHistogram
from gfm_runtime.states import STATES

_FRESH_S = 0.2  # for so long all scrapes get the same metrics
_HALF_OPEN, _HALF_OPEN_S = 64, 5.0  # connections that have not asked yet, and how long they may
_QUEUE = 128  # connections that the kernel keeps until they are accepted
_WINDOW_S = 10.0  # window of the quantiles, in the run's time
_SLACK = (0.0, 0.001, 0.01, 0.5)  # low slack is bad
_ROUND_TRIP = (0.5, 0.99, 0.999, 1.0)  # long round trips are bad


class RunCollector(Collector):
    """The metrics of one run, for scrapes in any thread.

    Attributes:
        follower: of the run; None before the run begins: there is nothing to collect.
    """

    def __init__(self, follower: Follower | None = None) -> None:
        self.follower = follower
        self._operator: Operator | None = None
        self._lock = threading.Lock()
        self._found: list[Metric] = []
        self._until = 0.0

    def close(self) -> None:
        """Close what ``collect`` has opened."""
        if self._operator is not None:
            self._operator.close()

    def collect(self) -> Iterator[Metric]:
        """The metrics, at most ``_FRESH_S`` old."""
        with self._lock:
            if self.follower is not None and time.monotonic() > self._until:
                of = self.follower
                self._found = [*self._counts(of), *self._times(of), *self._words(of)]
                self._until = time.monotonic() + _FRESH_S
            yield from self._found

    def _counts(self, follower: Follower) -> Iterator[Metric]:
        ticks, misses = _metric("gfmhil_ticks_total"), _metric("gfmhil_misses_total")
        for role in follower.run.parts:
            ticks.add_metric([role], float(follower.run.done(role)))
            if role == "plant":
                misses.add_metric([], float(follower.run.misses))
        yield ticks
        yield misses

    def _times(self, follower: Follower) -> Iterator[Metric]:
        """Quantiles of slack and round trip over the newest ticks; in lockstep no slack."""
        run, T_s = follower.run, follower.T_s
        if "plant" not in run.parts:
            return
        done = run.done("plant")
        window = max(0, done - round(_WINDOW_S / T_s)), done
        slack = SLACK.spread(run.columns, T_s, *window)
        trips = ROUND_TRIP.spread(run.columns, T_s, *window)
        yield _quantiles("gfmhil_slack_seconds", slack, _SLACK)
        yield _quantiles("gfmhil_round_trip_seconds", trips, _ROUND_TRIP)

    def _words(self, follower: Follower) -> Iterator[Metric]:
        seen = self._seen(follower)
        if "state" in seen:
            state = _metric("gfmhil_state")
            for name in STATES:
                state.add_metric([name], float(name == seen["state"]))
            yield state
        for label, key in (("law", "law_title"), ("reason", "reason"), ("trip", "trip")):
            if key in seen:
                metric = _metric(f"gfmhil_{label}_info")
                metric.add_metric([str(seen[key])], 1.0)
                yield metric

    def _seen(self, follower: Follower) -> dict[str, Any]:
        """The newest tick in words; laws by index if no command server gives their names."""
        seen: dict[str, Any] = {}
        with contextlib.suppress(UserError):  # no command server, or none yet
            self._operator = self._operator or Operator(follower.folder)
            seen = self._operator.snapshot()
        done = follower.run.done("controller")
        if done and not seen:
            row = follower.run.row("controller", done - 1)
            seen = {"state": STATES[int(row["state"])], "law_title": str(int(row["law"]))}
        return seen


def _metric(name: str) -> CounterMetricFamily | GaugeMetricFamily:
    about = METRICS[name]
    kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
    return kind(name, about.text, labels=[about.label] if about.label else [])


def _quantiles(name: str, found: DurationHistogram, quantiles: tuple[float, ...]) -> Metric:
    metric = _metric(name)
    for q in quantiles if found else ():
        metric.add_metric([f"{q:g}"], found.percentile(100 * q) * 1e-9)
    return metric


class _Request(WSGIRequestHandler):
    server: _Server

    def parse_request(self) -> bool:
        self.server.socket.keep(self.connection.fileno())  # it has asked
        return super().parse_request()

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing about a request."""


class _Server(ThreadingMixIn, WSGIServer):
    """A thread for each connection. Any number of them that ask nothing, or ask at once, leaves
    room for another.

    Raises:
        OSError: the port cannot be bound.
    """

    daemon_threads = True
    socket: Listener

    def __init__(self, host: str, port: int, app: Callable[..., Any]) -> None:
        self.socket = Listener(host, port, _HALF_OPEN, _HALF_OPEN_S, _HALF_OPEN_S)
        BaseServer.__init__(self, self.socket.getsockname(), _Request)
        self.socket.listen(_QUEUE)
        self.server_name, self.server_port = host, self.socket.port
        self.setup_environ()
        self.set_app(app)

    def service_actions(self) -> None:
        """End the connections that have asked nothing for too long."""
        self.socket.reap()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that disconnects is not an error."""


@contextlib.contextmanager
def serve_metrics(collector: RunCollector, host: str, port: int) -> Iterator[int]:
    """Serve metrics at ``/metrics`` while in this context; yields the port.

    Raises:
        UserError: the port cannot be bound.
    """
    registry = CollectorRegistry()
    registry.register(collector)
    try:
        server = _Server(host, port, make_wsgi_app(registry))
    except OSError as problem:
        raise UserError(f"--prometheus {port}: {host}: {problem.strerror}") from None
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_port)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        collector.close()
