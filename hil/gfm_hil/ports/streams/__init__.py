"""Streams a run's recording while it grows: to PlotJuggler, to our own tools, to Prometheus.

A separate process reads the files to which the loop appends, and does not disturb the loop.
"""

from gfm_hil.ports.streams.messages import BlockReader, TickBlock

__all__ = ["BlockReader", "TickBlock"]
