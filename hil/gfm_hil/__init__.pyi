from .core.errors import PeerLost, UserError
from .results.runner import Run, run_scenario
from .scenario import Scenario, load_scenario

__all__ = ["PeerLost", "Run", "Scenario", "UserError", "load_scenario", "run_scenario"]
