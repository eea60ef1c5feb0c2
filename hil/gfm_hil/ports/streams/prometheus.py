"""Prometheus metrics of a run, computed from the recording at each scrape."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from socketserver import BaseServer, ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gfm_hil.core.errors import UserError, naming
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.streams.port import METRICS, Follower
from gfm_hil.recording.live import LiveRun
from gfm_hil.recording.timing import ROUND_TRIP, SLACK
from gfm_runtime.states import STATES

_FRESH_S = 0.2  # for so long all scrapes get the same metrics
_HALF_OPEN, _HALF_OPEN_S = 64, 5.0  # connections that have not asked yet, and how long they may
_QUEUE = 128  # connections that the kernel keeps until they are accepted
_WINDOW_S = 10.0  # window of the quantiles, in the run's time


_Family = CounterMetricFamily | GaugeMetricFamily
_Values = tuple[str, Iterable[tuple[str, float]]]  # of a metric by name, by what its label says


class RunCollector(Collector):
    """The metrics of a run, of a network with the label ``converter``; for scrapes in any thread.
    It has the followers of the run, or of each converter; none before the run begins."""

    def __init__(self, followers: Sequence[Follower] = ()) -> None:
        self.followers = followers
        self._operators: dict[Follower, Operator] = {}
        self._lock = threading.Lock()
        self._found: list[Metric] = []
        self._until = 0.0

    def close(self) -> None:
        """Close what ``collect`` has opened."""
        for operator in self._operators.values():
            operator.close()

    def collect(self) -> Iterator[Metric]:
        """The metrics, at most ``_FRESH_S`` old."""
        with self._lock:
            if self.followers and time.monotonic() > self._until:
                families: dict[str, _Family] = {}
                for of in self.followers:
                    seen = self._newest(of)
                    for name, values in (*_counts(of.run), *_times(of.run), *_words(seen)):
                        _put(families, name, values, of.converter)
                self._found = [*families.values()]
                self._until = time.monotonic() + _FRESH_S
            yield from self._found

    def _newest(self, follower: Follower) -> dict[str, Any]:
        """The newest tick in words; laws by index if no command server gives their names."""
        seen: dict[str, Any] = {}
        with contextlib.suppress(UserError):  # no command server, or none yet
            if follower not in self._operators:
                self._operators[follower] = Operator(follower.folder)
            seen = self._operators[follower].snapshot()
        done = follower.run.done("controller")
        if done and not seen:
            row = follower.run.row("controller", done - 1)
            seen = {"state": STATES[int(row["state"])], "law_title": str(int(row["law"]))}
        return seen


def _put(
    families: dict[str, _Family], name: str, values: Iterable[tuple[str, float]], converter: str
) -> None:
    """Add values of a metric, by what its label says, and in a network by the converter."""
    label, text = METRICS[name]
    kind = CounterMetricFamily if name.endswith("_total") else GaugeMetricFamily
    labels = [*filter(None, ("converter" if converter else "", label))]
    metric = families.setdefault(name, kind(name, text, labels=labels))
    for what, value in values:
        metric.add_metric([converter] * bool(converter) + [what] * bool(label), float(value))


def _counts(run: LiveRun) -> Iterator[_Values]:
    yield "gfmhil_ticks_total", [(role, run.done(role)) for role in run.parts]
    yield "gfmhil_misses_total", [("", run.misses)] if "plant" in run.parts else []


def _times(run: LiveRun) -> Iterator[_Values]:
    """Quantiles of slack and round trip over the newest ticks; in lockstep no slack."""
    if "plant" not in run.parts:
        return
    done = run.done("plant")
    window = max(0, done - round(_WINDOW_S / run.T_s)), done
    for name, duration, quantiles in (
        ("gfmhil_slack_seconds", SLACK, (0.0, 0.001, 0.01, 0.5)),  # low slack is bad
        ("gfmhil_round_trip_seconds", ROUND_TRIP, (0.5, 0.99, 0.999, 1.0)),  # long ones are bad
    ):
        found = duration.histogram(run.columns, run.T_s, *window)
        values = [(f"{q:g}", found.percentile(100 * q) * 1e-9) for q in quantiles if found]
        yield name, values


def _words(seen: dict[str, Any]) -> Iterator[_Values]:
    if "state" in seen:
        yield "gfmhil_state", [(name, name == seen["state"]) for name in STATES]
    for label, key in (("law", "law_title"), ("reason", "reason"), ("trip", "trip")):
        if key in seen:
            yield f"gfmhil_{label}_info", [(str(seen[key]), 1.0)]


class _Request(WSGIRequestHandler):
    server: _Server

    def parse_request(self) -> bool:
        self.server.socket.exempt(self.connection.fileno())  # it has asked
        return super().parse_request()

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing about a request."""


class _Server(ThreadingMixIn, WSGIServer):
    """A thread for each connection. Any number of them that ask nothing, or ask at once, leaves
    room for another. Raises OSError: the port cannot be bound."""

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
    """Serve metrics at ``/metrics`` while in this context; yields the port. Raises UserError: the
    port cannot be bound."""
    registry = CollectorRegistry()
    registry.register(collector)
    with naming(f"--prometheus {port}: {host}"):
        server = _Server(host, port, make_wsgi_app(registry))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield int(server.server_port)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        collector.close()
