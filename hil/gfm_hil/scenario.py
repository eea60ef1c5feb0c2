"""Scenario files: everything that a run needs, in TOML, checked before anything starts."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gfm_hil.errors import UserError, lines
from gfm_hil.events import GridImpedance, apply_grid_event
from gfm_hil.scenario_model import INPROC, LatePolicy, Link, References, Scenario
from gfm_plant import make_plant
from gfm_runtime import LawError, discretise, load_law

__all__ = [
    "LatePolicy",
    "Link",
    "References",
    "Scenario",
    "check_scenario",
    "find_scenario",
    "load_scenario",
    "shipped_scenarios",
]

SCENARIO_FOLDERS = (
    Path(__file__).resolve().parent / "scenarios",  # a wheel carries them here
    Path(__file__).resolve().parents[2] / "scenarios",  # a checkout has them here
)


def find_scenario(name: str) -> Path:
    """The file of a scenario: a path, or the name of a shipped one (with or without .toml).

    Raises:
        UserError: neither exists.
    """
    given = Path(name)
    if given.is_file():
        return given
    for folder in SCENARIO_FOLDERS:
        for candidate in (folder / given.name, folder / f"{given.name}.toml"):
            if candidate.is_file():
                return candidate
    raise UserError(f"scenario {name}: no such file; shipped are {shipped_scenarios()}")


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with gfmhil."""
    return sorted({p.stem for folder in SCENARIO_FOLDERS for p in folder.glob("*.toml")})


def load_scenario(name: str, **changed: Any) -> Scenario:
    """Read, override and check a scenario, its laws and its plant.

    Args:
        name: path or shipped name.
        changed: overrides by dotted path with ``__`` for the dot, e.g. ``link__type="inproc"``;
            None leaves the file's value. Another link than the file's forgets its endpoint
            and options.

    Raises:
        UserError: one line a mistake, each with its path, the value and what is allowed.
    """
    path = find_scenario(name)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as problem:
        raise UserError(f"{path}: {problem}") from None
    link, chosen = content.get("link"), changed.get("link__type")
    if isinstance(link, dict) and chosen not in (None, INPROC, link.get("type", "zmq")):
        link.pop("endpoint", None)  # they are of the file's own link
        link.pop("options", None)
    for key, value in changed.items():
        if value is not None:
            table: Any = content
            *parents, last = key.split("__")
            for parent in parents:
                table = table.setdefault(parent, {}) if isinstance(table, dict) else None
            if isinstance(table, dict):  # else the check says what the file has instead
                table[last] = value
    return check_scenario(content, str(path))


def check_scenario(content: dict[str, Any], where: str) -> Scenario:
    """The scenario of a dict, with its laws and its plant tried out.

    Raises:
        UserError: as ``load_scenario``.
    """
    try:
        scenario = Scenario.model_validate(content)
    except ValidationError as problem:
        raise UserError("\n".join(f"{where}: {line}" for line in lines(problem))) from None
    try:
        for law in [*scenario.laws(), *scenario.compare]:
            for stage in load_law(law).laws:
                discretise(stage, scenario.T_s)
        _try_plant(scenario)
    except (LawError, UserError) as problem:
        raise UserError(f"{where}: {problem}") from None
    return scenario


def _try_plant(scenario: Scenario) -> None:
    """Make the plant and every line that its events give it, which may be too fast to resolve."""
    converter = f"plant.converter = {scenario.plant.converter!r}"
    try:
        par, st = make_plant(scenario.plant, scenario.T_s)
    except ValidationError as problem:
        raise UserError("; ".join(f"{converter}: {line}" for line in lines(problem))) from None
    except OSError as problem:
        raise UserError(f"{converter}: {problem.strerror}") from None
    except tomllib.TOMLDecodeError as problem:
        raise UserError(f"{converter}: not TOML: {problem}") from None
    except ValueError as problem:
        raise UserError(str(problem)) from None
    for k, event in enumerate(scenario.events):
        if isinstance(event, GridImpedance):
            try:
                apply_grid_event(event, par, st)
            except ValueError as problem:
                raise UserError(f"events.{k}: {problem}") from None
