"""A scenario as TOML text with every default (the standard library only reads TOML)."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

from gfm_hil.core.files import write_text
from gfm_hil.scenario.events import GridProfile
from gfm_hil.scenario.model import Scenario


def scenario_toml(scenario: Scenario) -> str:
    """The resolved scenario as TOML; ``load_scenario`` reads it back to an equal one."""
    return toml_text(scenario.model_dump(mode="json", exclude_none=True))


def write_scenario(folder: Path, scenario: Scenario) -> None:
    """Write ``scenario.toml`` into a run folder, with the files of its courses in ``profiles``.

    Raises:
        OSError: a file cannot be read or written.
    """
    events, taken = [], dict[str, str]()
    for k, event in enumerate(scenario.events):
        if isinstance(event, GridProfile):
            name = Path(event.file).name
            name = f"{k}-{name}" if taken.get(name, event.file) != event.file else name
            taken[name] = event.file
            copy = folder / "profiles" / name
            copy.parent.mkdir(exist_ok=True)
            if not (copy.exists() and copy.samefile(event.file)):
                shutil.copyfile(event.file, copy)
            event = event.model_copy(update={"file": f"profiles/{name}"})
        events.append(event)
    written = scenario.model_copy(update={"events": events})
    write_text(folder / "scenario.toml", scenario_toml(written))


def toml_text(content: dict[str, Any]) -> str:
    """Nested tables, lists of tables and plain values as TOML."""
    return "\n".join(_table(content, ())) + "\n"


def _table(content: dict[str, Any], path: tuple[str, ...]) -> list[str]:
    plain = {k: v for k, v in content.items() if not _is_table(v) and not _is_tables(v)}
    lines = [f"[{'.'.join(path)}]"] if path and (plain or not content) else []
    lines += [f"{_key(key)} = {_value(value)}" for key, value in plain.items()]
    if lines:
        lines.append("")
    for key, value in content.items():
        if _is_table(value):
            lines += _table(value, (*path, _key(key)))
        elif _is_tables(value):
            for entry in value:
                lines.append(f"[[{'.'.join((*path, _key(key)))}]]")
                lines += [f"{_key(k)} = {_value(v)}" for k, v in entry.items()]
                lines.append("")
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) for v in value)


def _key(name: str) -> str:
    """A key as it is where TOML allows that, else in quotes, e.g. a dotted path of a campaign."""
    return name if re.fullmatch("[A-Za-z0-9_-]+", name) else _value(name)


def _value(value: Any) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return repr(value) if math.isfinite(value) else str(value)
        case int():
            return str(value)
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case list():
            return "[" + ", ".join(_value(v) for v in value) + "]"
        case dict():
            return "{" + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + "}"
    raise TypeError(f"{value!r} has no TOML form here")
