"""What a run records, sent on while it goes on: to PlotJuggler, to tools of our own, to Prometheus.

A process of its own reads the files that the loop appends to; nothing of it is in the loop's way.
"""

from gfm_hil.telemetry.blocks import Block, BlockReader

__all__ = ["Block", "BlockReader"]
