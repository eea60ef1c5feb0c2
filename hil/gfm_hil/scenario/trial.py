"""Checks a scenario whole: its keys, then its laws and its plant by building them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from pydantic import ValidationError

from gfm_hil.core.errors import UserError, lines
from gfm_hil.scenario.events.base import PlantEvent
from gfm_hil.scenario.schema import Scenario
from gfm_plant import ConverterParameters, Network, load_converter, make_network, make_plant
from gfm_runtime import Law, LawError, discretise, load_law
from gfm_runtime.errors import printable
from gfm_runtime.inner_file import named_inner
from gfm_runtime.toml_file import read_toml


def check_scenario(
    content: dict[str, Any],
    where: str,
    overrides: Mapping[tuple[str, ...], str] = MappingProxyType({}),
) -> Scenario:
    """The scenario of a dict, with its laws and its plant tried out.

    Args:
        content: plain data.
        where: the file it comes from.
        overrides: what does not come from there, by its path: an option with its value.

    Raises:
        UserError: as ``load_scenario``.
    """

    def source(path: tuple[str | int, ...]) -> str:
        """Where the value at a path comes from; a table may come from several places."""
        for part, option in overrides.items():
            if path[: len(part)] == part:
                return option
        inside = [option for part, option in overrides.items() if part[: len(path)] == path]
        return " with ".join([where, ", ".join(inside)] if inside else [where])

    try:
        scenario = Scenario.model_validate(content)
    except ValidationError as problem:
        raise UserError("\n".join(lines(problem, Scenario, source, content))) from None
    wrong: list[str] = []
    if scenario.inner is not None:
        try:
            named_inner(scenario.inner)
        except LawError as problem:
            ours = "" if ("inner",) in overrides else f"{where}: "
            raise UserError("\n".join(ours + line for line in problem.lines)) from None
    for member in [scenario.of(name) for name in scenario.converters]:
        for law in member.laws():
            try:
                for stage in load_law(law, member.inner).laws:
                    _try_law(law, stage, scenario.T_s)
            except LawError as problem:
                key = "inner" if _no_stage(member.inner) else "law"
                at = f"network.converters.{member.converter}.{key}: "
                wrong += [f"{where}: {at}{line}" for line in problem.lines]
    for law in dict.fromkeys([*scenario.laws(), *scenario.compare]):
        ours = "" if law == scenario.law and ("law",) in overrides else f"{where}: "
        try:
            for stage in load_law(law, scenario.inner).laws:
                _try_law(law, stage, scenario.T_s)
        except LawError as problem:
            wrong += [ours + line for line in problem.lines]
    try:
        _try_plant(scenario)
    except UserError as problem:
        wrong.append(f"{source(('plant',))}: {problem}")
    if wrong:
        raise UserError("\n".join(map(printable, wrong)))
    return scenario


def _no_stage(name: str | None) -> bool:
    """Whether there is no such inner stage."""
    try:
        if name is not None:
            named_inner(name)
    except LawError:
        return True
    return False


def _try_law(name: str, stage: Law, T_s: float) -> None:
    try:
        discretise(stage, T_s)
    except LawError as problem:
        raise problem.within(f"law {name}") from None


def plant_of(scenario: Scenario) -> Network:
    """The plant of a scenario: one converter, or those of its network.

    Raises:
        ValueError: as ``make_plant`` and ``make_network``.
    """
    if scenario.network is None:
        options = scenario.plant
        options = options.with_seed(scenario.seed) if scenario.seed else options
        return make_plant(options, scenario.T_s)
    converters = {}
    for name, member in scenario.network.converters.items():
        options = scenario.of(name).plant
        if scenario.seed:
            options = options.with_seed(scenario.seed)
        converters[name] = (options, member.node)
    return make_network(converters, scenario.T_s, scenario.plant.grid, scenario.network)


def _try_plant(scenario: Scenario) -> None:
    """Build the plant and try those of its events that not every plant can carry out."""
    plants = {"plant.": scenario.plant} | {
        f"network.converters.{name}.plant.": scenario.of(name).plant for name in scenario.converters
    }
    for of, options in plants.items():
        place = f"{of}converter = {options.converter!r}"
        if not options.converter.endswith(".toml"):
            try:
                load_converter(options.converter)
            except ValueError as problem:  # names key and value itself
                raise UserError(f"{of}{problem}") from None
            continue
        try:
            ConverterParameters.model_validate(read_toml(options.converter))
        except ValidationError as problem:
            wrong = lines(problem, ConverterParameters)
            raise UserError("; ".join(f"{place}: {line}" for line in wrong)) from None
        except ValueError as problem:
            raise UserError(f"{place}: {problem}") from None
    try:
        plant = plant_of(scenario)
    except ValueError as problem:
        raise UserError(str(problem)) from None
    for k, event in enumerate(scenario.events):
        if isinstance(event, PlantEvent):
            try:
                event.try_on(plant)
            except (UserError, ValueError) as problem:
                raise UserError(f"events.{k}: {problem}") from None
