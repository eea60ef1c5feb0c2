"""Prometheus metrics of a run, computed from the recording at each scrape."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gfm_hil.core.errors import UserError
from gfm_hil.operator import Operator
from gfm_hil.recording.timing import ROUND_TRIP, SLACK, Spread
from gfm_hil.telemetry.follow import Follower
from gfm_hil.telemetry.metrics import METRICS
from gfm_runtime.states import STATES

_WINDOW_S = 10.0  # window of the quantiles, in the run's time
_SLACK = (0.0, 0.001, 0.01, 0.5)  # low slack is bad
_ROUND_TRIP = (0.5, 0.99, 0.999, 1.0)  # long round trips are bad


class RunCollector(Collector):
    """The metrics of one run.

    Attributes:
        follower: of the run; None before the run begins: there is nothing to collect.
    """

    def __init__(self, follower: Follower | None = None) -> None:
        self.follower = follower
        self._operator: Operator | None = None

    def close(self) -> None:
        """Close what ``collect`` has opened."""
        if self._operator is not None:
            self._operator.close()

    def collect(self) -> Iterator[Metric]:
        """The present metrics."""
        if self.follower is not None:
            yield from self._counts(self.follower)
            yield from self._times(self.follower)
            yield from self._words(self.follower)

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


def _quantiles(name: str, found: Spread, quantiles: tuple[float, ...]) -> Metric:
    metric = _metric(name)
    for q in quantiles if found else ():
        metric.add_metric([f"{q:g}"], found.percentile(100 * q) * 1e-9)
    return metric


def _say_nothing(*_: object) -> None:
    """Print nothing about a failed connection."""


@contextlib.contextmanager
def serve_metrics(collector: RunCollector, host: str, port: int) -> Iterator[int]:
    """Serve metrics at ``/metrics`` while in this context; yields the port.

    Raises:
        UserError: the port cannot be bound.
    """
    registry = CollectorRegistry()
    registry.register(collector)
    try:
        server, thread = start_http_server(port, addr=host, registry=registry)
    except OSError as problem:
        raise UserError(f"--prometheus {port}: {host}: {problem.strerror}") from None
    # A client that disconnects is not an error; socketserver would print a traceback.
    setattr(server, "handle_error", _say_nothing)  # noqa: B010 (mypy takes it for a method)
    try:
        yield int(server.server_port)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        collector.close()
