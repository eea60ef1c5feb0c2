"""Scenario files: everything that a run needs, in TOML, checked before anything starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from gfm_hil.errors import UserError, lines
from gfm_hil.events import GridImpedance, apply_grid_event
from gfm_hil.scenario_model import INPROC, LatePolicy, Link, References, Scenario
from gfm_plant import make_plant
from gfm_runtime import LawError, discretise, load_law
from gfm_runtime.errors import printable
from gfm_runtime.toml_file import read_toml

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
    return find_file("scenario", name, "*.toml")


def find_file(kind: str, name: str, pattern: str) -> Path:
    """The file of that path, or the shipped one of that name; ``kind`` is for the message.

    Raises:
        UserError: neither exists.
    """
    given, shipped = Path(name), _shipped(pattern)
    try:
        is_file, exists = given.is_file(), given.exists()
    except OSError as problem:  # such as a name of 300 characters
        raise UserError(printable(f"{kind} {name}: {problem.strerror}")) from None
    if is_file:
        return given
    if given.name.removesuffix(".toml") in shipped:
        return shipped[given.name.removesuffix(".toml")]
    what = "is not a regular file" if exists else "no such file"
    raise UserError(printable(f"{kind} {name}: {what}; shipped are {sorted(shipped)}"))


def _shipped(pattern: str) -> dict[str, Path]:
    return {p.stem: p for folder in SCENARIO_FOLDERS for p in folder.glob(pattern)}


def shipped_scenarios() -> list[str]:
    """Names of the scenarios that come with gfmhil."""
    return sorted(_shipped("*.toml"))


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
        content = read_toml(path)
    except ValueError as problem:
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
    where = printable(where)
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
    if scenario.plant.converter.endswith(".toml"):
        try:
            read_toml(scenario.plant.converter)
        except ValueError as problem:
            raise UserError(f"{converter}: {problem}") from None
    try:
        par, st = make_plant(scenario.plant, scenario.T_s)
    except ValidationError as problem:
        raise UserError("; ".join(f"{converter}: {line}" for line in lines(problem))) from None
    except ValueError as problem:
        raise UserError(str(problem)) from None
    for k, event in enumerate(scenario.events):
        if isinstance(event, GridImpedance):
            try:
                apply_grid_event(event, par, st)
            except ValueError as problem:
                raise UserError(f"events.{k}: {problem}") from None
