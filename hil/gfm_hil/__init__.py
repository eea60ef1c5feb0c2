"""The bench: frames, links, the two processes, scenarios, recording, reports and the CLI."""

import gfm_hil.blas  # noqa: F401  before NumPy
from gfm_hil.errors import PeerLost, UserError
from gfm_hil.runner import Run, run_scenario
from gfm_hil.scenario import Scenario, load_scenario

__all__ = ["PeerLost", "Run", "Scenario", "UserError", "load_scenario", "run_scenario"]
