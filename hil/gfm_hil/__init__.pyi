from .core.errors import PeerLost, UserError
from .recording.run import Run
from .run.runner import run_scenario
from .scenario import Scenario, load_scenario

__all__ = ["PeerLost", "Run", "Scenario", "UserError", "load_scenario", "run_scenario"]
