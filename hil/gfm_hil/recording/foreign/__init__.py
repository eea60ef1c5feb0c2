"""Recordings that others made, of hardware, PSCAD or RTDS, as runs of ours: a map says what their
channels are, and what the sampling cannot show is told."""

from gfm_hil.recording.foreign.as_run import ABOUT, open_recording
from gfm_hil.recording.foreign.files import FILES
from gfm_hil.recording.foreign.voltage_profile import grid_profile

__all__ = ["ABOUT", "FILES", "grid_profile", "open_recording"]
