"""A scenario as TOML text with every default (the standard library only reads TOML)."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from gfm_hil.scenario.model import Scenario


def scenario_toml(scenario: Scenario) -> str:
    """The resolved scenario as TOML; ``load_scenario`` reads it back to an equal one."""
    return toml_text(scenario.model_dump(mode="json", exclude_none=True))


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
