"""Streams a run's recording while it grows: to PlotJuggler, to our own tools, to Prometheus."""

from gfm_hil.ports.streams.messages import BlockReader, TickBlock

__all__ = ["BlockReader", "TickBlock"]
