"""The keys of a scenario as Markdown tables, from the models that check it."""

from __future__ import annotations

import inspect
import types
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from gfm_hil.core.terminal import markdown
from gfm_hil.links.impaired import Impairment
from gfm_hil.scenario import schema as scenario
from gfm_hil.scenario.events import EVENTS
from gfm_hil.scenario.events.base import Event
from gfm_hil.scenario.events.breaker import SynchroCheck
from gfm_hil.scenario.expectation import END_REASONS
from gfm_plant import options
from gfm_plant.components import COMPONENTS, FiniteGrid
from gfm_plant.components.synchronous_machine import ROLES
from gfm_runtime import inner, law, lawfile


def _table_of(key: str) -> type[BaseModel]:
    return cast(type[BaseModel], scenario.Scenario.model_fields[key].annotation)


TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("top level", scenario.Scenario),
    ("[references]", _table_of("references")),
    ("[link]", _table_of("link")),
    ("[link.impairment]", Impairment),
    ("[late_policy]", _table_of("late_policy")),
    ("[plant]", options.Plant),
    ("[plant.dc_source]", options.DcSource),
    ("[plant.lcl]", options.SecondInductor),
    ("[plant.grid]", options.Grid),
    ("[plant.grid.finite]", FiniteGrid),
    ("[plant.sensors]", options.Sensors),
    ("[plant.adc]", options.AnalogToDigital),
    ("[plant.dac]", options.DigitalToAnalog),
    ("[plant.delay]", options.Delay),
    ("[plant.protection]", options.Protection),
)
NETWORK_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("[network]", scenario.NetworkSettings),
    ("[network.converters.NAME]", scenario.NetworkConverter),
    *((f"[network.{table}.NAME]", kind) for table, kind in COMPONENTS.items()),
    *(
        (f"{role} of [network.synchronous_machines.NAME], type {kind.kind()}", kind)
        for role, (_, kinds) in ROLES.items()
        for kind in kinds
    ),
)
CHECK = ("check", SynchroCheck)
OVERLOAD = ("[[plant.protection.overload]]", options.Overload)
TRIP = ("one protection, e.g. [plant.protection.over_current]", options.Trip)
LAW_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("top level", lawfile.LawFile),
    ("[error_map]", lawfile.ErrorMap),
    ("[u_0]", lawfile.SetPoints),
    ("[parameters.NAME]", law.Parameter),
    ("an element of [phi] or [psi]", lawfile.ElementSpec),
    ("[limits]", law.Limits),
    ("[home_grid]", law.HomeGrid),
    ("[schedule]", lawfile.Schedule),
    ("one of schedule.stages", lawfile.SchedulePoint),
)
INNER_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    *((f'type = "{kind}"', model) for kind, model in inner.STAGES.items()),
    ("[inner.power]", inner.PowerLimiter),
)

_BOUNDS = (("gt", ">"), ("ge", "≥"), ("lt", "<"), ("le", "≤"))


def _type(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(arguments[0])
    if origin is Literal:
        return " or ".join(f'`"{a}"`' if isinstance(a, str) else f"`{a}`" for a in arguments)
    if origin in (Union, types.UnionType):
        names = dict.fromkeys(_type(a) for a in arguments if a is not type(None))
        return " or ".join(names)
    if origin is dict:
        return "table" if _type(arguments[0]) == "string" else f"table of {_type(arguments[0])}"
    if origin in (list, tuple):
        return "array"
    if inspect.isclass(hint) and issubclass(hint, BaseModel):
        return "table"
    return {float: "number", int: "integer", str: "string", bool: "true or false"}.get(hint, "")


def _bounds(field: FieldInfo) -> str:
    metadata = list(field.metadata)
    for argument in get_args(field.annotation) or ():
        metadata += get_args(argument)[1:] if get_origin(argument) is Annotated else ()
    for one in list(metadata):
        metadata += list(getattr(one, "metadata", []))
    found = [
        f"{sign} {getattr(m, name):g}"
        for name, sign in _BOUNDS
        for m in metadata
        if getattr(m, name, None) is not None
    ]
    return ", ".join(dict.fromkeys(found)).replace("9.22337e+18", "2⁶³")


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    if value is None:
        return "none"
    if isinstance(value, options.Trip):
        return f"{value.threshold:g} p.u., {value.delay_s:g} s"
    if isinstance(value, BaseModel) or value in ({}, [], (), ""):
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


def table(model: type[BaseModel], leave_out: tuple[str, ...] = ()) -> str:
    """One row a key."""
    rows = []
    for name, field in model.model_fields.items():
        if name in leave_out:
            continue
        bounds = _bounds(field)
        kind = _type(field.annotation) + (f" {bounds}" if bounds else "")
        if not field.description:
            raise KeyError(f"{model.__name__}.{name} has no description")
        text = field.description.replace("|", "\\|")
        rows.append((f"`{name}`", kind, _default(field), text))
    return markdown(("key", "value", "default", "meaning"), rows)


def _tables(tables: tuple[tuple[str, type[BaseModel]], ...]) -> str:
    """Several tables of a file, each below its title."""
    titled = [(f"`{t}`" if t[0] == "[" else t, model) for t, model in tables]
    return "\n".join(f"**{title}**\n\n{table(model)}\n" for title, model in titled)


def scenario_tables() -> str:
    """Every table of a scenario file."""
    return _tables((*TABLES, TRIP, OVERLOAD))


def check_table() -> str:
    """The keys of a synchro-check."""
    return _tables((CHECK,))


def end_reasons() -> str:
    """The names that ``expect_reason`` may give, by status."""
    named = {status: [f"`{name}`" for name in names] for status, names in END_REASONS.items()}
    rows = [(f"`{status}`", ", ".join(names)) for status, names in named.items() if names]
    return markdown(("`expect`", "`expect_reason`"), rows)


def event_tables() -> str:
    """Every kind of event."""
    lines = ["All events:", "", table(Event), ""]
    for kind, model in EVENTS.items():
        lines += [f'**`type = "{kind}"`** {inspect.cleandoc(model.__doc__ or "")}', ""]
        lines += [table(model, ("type", "t", "tick")), ""]
    return "\n".join(lines)


def inner_tables() -> str:
    """Every kind of inner stage, and its power limiter."""
    return _tables(INNER_TABLES)


def network_tables() -> str:
    """Every table of the network in a scenario file."""
    return _tables(NETWORK_TABLES)


def law_tables() -> str:
    """Every table of a law file."""
    return _tables(LAW_TABLES)
