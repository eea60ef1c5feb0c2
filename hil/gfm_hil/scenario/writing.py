"""Writes a scenario, and other plain content, as TOML."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from gfm_hil.core.files import write_text
from gfm_hil.scenario.schema import Scenario


def scenario_toml(scenario: Scenario) -> str:
    """The resolved scenario as TOML; ``load_scenario`` reads it back to an equal one."""
    return toml_text(scenario.model_dump(mode="json", exclude_none=True))


def toml_text(content: dict[str, Any]) -> str:
    """Nested tables, lists of tables and plain values as TOML."""
    import tomlkit  # here: few commands write

    return tomlkit.dumps(content)


def write_scenario(folder: Path, scenario: Scenario) -> None:
    """Write ``scenario.toml`` into a run folder, with the files of its events in ``profiles``.

    Raises:
        OSError: a file cannot be read or written.
    """
    events, taken = [], dict[str, str]()
    for k, event in enumerate(scenario.events):
        if (file := getattr(event, "file", None)) is not None:
            name = Path(file).name
            name = f"{k}-{name}" if taken.get(name, file) != file else name
            taken[name] = file
            copy = folder / "profiles" / name
            copy.parent.mkdir(exist_ok=True)
            if not (copy.exists() and copy.samefile(file)):
                shutil.copyfile(file, copy)
            event = event.model_copy(update={"file": f"profiles/{name}"})
        events.append(event)
    written = scenario.model_copy(update={"events": events})
    write_text(folder / "scenario.toml", scenario_toml(written))
