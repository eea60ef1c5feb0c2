from .loading import (
    SCENARIO_FOLDERS,
    find_file,
    find_scenario,
    load_scenario,
    look_beside,
    shipped_scenarios,
)
from .schema import (
    INPROC,
    LatePolicy,
    LinkSettings,
    NetworkConverter,
    NetworkSettings,
    References,
    Scenario,
)
from .trial import check_scenario, plant_of
from .writing import scenario_toml, toml_text, write_scenario

__all__ = [
    "INPROC",
    "SCENARIO_FOLDERS",
    "LatePolicy",
    "LinkSettings",
    "NetworkConverter",
    "NetworkSettings",
    "References",
    "Scenario",
    "check_scenario",
    "find_file",
    "find_scenario",
    "load_scenario",
    "look_beside",
    "plant_of",
    "scenario_toml",
    "shipped_scenarios",
    "toml_text",
    "write_scenario",
]
