from .model import Scenario, check_scenario, find_scenario, load_scenario

__all__ = ["Scenario", "check_scenario", "find_scenario", "load_scenario"]
