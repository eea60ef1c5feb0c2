"""The keys of a scenario as Markdown tables, from the models that check it."""

from __future__ import annotations

import inspect
import types
from typing import Annotated, Any, Literal, Union, cast, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from gfm_hil.links.impaired import Impairment
from gfm_hil.scenario import events
from gfm_hil.scenario import model as scenario
from gfm_hil.scenario.expectation import END_REASONS
from gfm_plant import options
from gfm_runtime import lawfile
from gfm_runtime.signals import group


def _table_of(key: str) -> type[BaseModel]:
    return cast(type[BaseModel], scenario.Scenario.model_fields[key].annotation)


_REFERENCE_TABLE = _table_of("references")
TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("top level", scenario.Scenario),
    ("[references]", _REFERENCE_TABLE),
    ("[link]", _table_of("link")),
    ("[link.impairment]", Impairment),
    ("[late_policy]", _table_of("late_policy")),
    ("[plant]", options.Plant),
    ("[plant.dc_source]", options.DcSource),
    ("[plant.grid]", options.Grid),
    ("[plant.sensors]", options.Sensors),
    ("[plant.adc]", options.AnalogToDigital),
    ("[plant.dac]", options.DigitalToAnalog),
    ("[plant.delay]", options.Delay),
    ("[plant.protection]", options.Protection),
)
TRIP = ("one protection, e.g. [plant.protection.over_current]", options.Trip)
EVENTS = get_args(get_args(events.Event)[0])
LAW_TABLES: tuple[tuple[str, type[BaseModel]], ...] = (
    ("top level", lawfile.LawFile),
    ("[error_map]", lawfile.ErrorMapSpec),
    ("[u_0]", lawfile.SetPoints),
    ("[parameters.NAME]", lawfile.ParameterSpec),
    ("an element of [phi] or [psi]", lawfile.ElementSpec),
    ("[limits]", lawfile.LimitsSpec),
    ("[home_grid]", lawfile.GridSpec),
    ("[schedule]", lawfile.Schedule),
    ("one of schedule.stages", lawfile.Stage),
)

#: what a model leaves to its name or docstring; the page does not build if a key is missing here
_MORE = {
    "Scenario.title": "of figures and reports",
    "Scenario.description": "for people",
    "Scenario.mode": "simulated time, or the clock; see below",
    "Scenario.references": "$Y_{ref}$ at the start",
    "Scenario.link": "between the two sides",
    "Scenario.late_policy": "real time only",
    "Scenario.plant": "converter, grid and instruments",
    "Scenario.events": "what happens; see below",
    "Plant.dc_source": "the source that feeds $C_{dc}$",
    "Plant.grid": "grid simulator at the start",
    "Plant.sensors": "between truth and A/D",
    "Plant.adc": '`"DS2004"` (16 bit) or a table; ideal if none',
    "Plant.dac": '`"DS2101"` (12 bit) or a table; ideal if none',
    "Plant.delay": "of the loop",
    "Plant.protection": "trips of the converter",
    "Delay.samples": "whole samples from y[k] to the effect of u[k]",
    "Delay.fraction": "of one more sample",
    "Trip.enabled": "false takes it out",
    "_Event.tick": "in place of `t`",
    "Reference.ramp_s": "spreads the change evenly over so many seconds",
    "Gains.values": "a table of names and numbers, e.g. `{ D_p = 0.02 }`",
    "LawChange.law": "catalogue name or law file",
    "GridFrequency.f_hz": "Hz",
    "GridFrequency.rate": "Hz/s; a step if none",
    "GridVoltage.V_g": "p.u.",
    "GridVoltage.rate": "p.u./s; a step if none",
    "GridVoltage.duration": "s; then the voltage returns (a sag)",
    "PhaseJump.degrees": "by which the grid's angle jumps ahead",
    "GridImpedance.L_g": "factor on the converter file's line inductor",
    "GridImpedance.R_g": "factor on its resistor",
    "Breaker.closed": "false opens it onto the local load",
    "LawFile.name": "lower case letters, digits, `_`, `.`, `-`",
    "LawFile.title": "for people",
    "LawFile.source": "where the law and its numbers come from",
    "LawFile.error_map": "what $\\Phi$ acts on",
    "LawFile.u_0": "set-points of u",
    "LawFile.parameters": "named numbers for the expressions",
    "LawFile.phi": "elements by cell, `ij` = row and column of the matrix",
    "LawFile.psi": "the terms in braces, by cell: on the feedback only",
    "LawFile.limits": "clamps of u, anti-windup",
    "LawFile.home_grid": "where the defaults are meant to be used",
    "LawFile.schedule": "gains by the estimated grid reactance",
    "ErrorMapSpec.type": "`linear`, `dc-energy`, `dvoc` or `hybrid-angle`",
    "ErrorMapSpec.R": "p.u., `hybrid-angle` only",
    "ErrorMapSpec.X": "p.u., `hybrid-angle` only",
    "SetPoints.i_u": "p.u., or the name of a reference",
    "SetPoints.omega_u": "p.u., or the name of a reference",
    "SetPoints.E_u": "p.u., or the name of a reference",
    "ParameterSpec.value": "the number",
    "ParameterSpec.unit": "e.g. `p.u.`, `1/s`",
    "ParameterSpec.source": "where the number comes from",
    "ParameterSpec.free": "[low, high] within which a synthesis may move it",
    "ParameterSpec.tied": "expression that it follows while a synthesis moves others",
    "ElementSpec.type": "kind of element",
    "ElementSpec.k": "gain",
    "ElementSpec.k_i": "integral gain, 1/s",
    "ElementSpec.T": "time constant, s",
    "ElementSpec.xi": "damping ratio of O",
    "ElementSpec.T_f": "s; multiplies by $1/(T_f s + 1)$",
    "LimitsSpec.i_u": "[low, high], p.u.",
    "LimitsSpec.omega_u": "[low, high], p.u.",
    "LimitsSpec.E_u": "[low, high], p.u.",
    "LimitsSpec.T_t": "tracking time constant of the anti-windup, s",
    "LimitsSpec.T_off": "decay of the offset left by a change of law, s",
    "GridSpec.L_g": "factor on the converter's line inductor",
    "GridSpec.R_g": "factor on its resistor",
    "GridSpec.note": "for people",
    "Stage.X": "upper end of the stage, p.u.; the last one has no end",
    "Stage.parameters": "values that differ from `[parameters]`",
    "Schedule.stages": "two to eight",
    "Schedule.hysteresis": "relative, on every boundary",
    "Schedule.dwell_s": "least time between two changes, s",
    "Schedule.X_0": "estimate to start from, p.u.",
    "Schedule.X_f": "reactance of the converter's own filter, taken off the estimate, p.u.",
}
_REFERENCES = {s.name: f"{s.description}, {s.low:g} to {s.high:g} {s.unit}" for s in group("ref")}
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
    for inner in list(metadata):
        metadata += list(getattr(inner, "metadata", []))
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
    if isinstance(value, BaseModel) or value in ({}, [], ""):
        return "–"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


def _meaning(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    if model in (_REFERENCE_TABLE, events.Reference) and name in _REFERENCES:
        return _REFERENCES[name]
    owners = [c.__name__ for c in model.__mro__]
    for owner in owners:
        if f"{owner}.{name}" in _MORE:
            return _MORE[f"{owner}.{name}"]
    if not field.description:
        raise KeyError(f"{model.__name__}.{name} has neither description nor entry in _MORE")
    return field.description


def table(model: type[BaseModel], leave_out: tuple[str, ...] = ()) -> list[str]:
    """One row a key."""
    lines = ["| key | value | default | meaning |", "|---|---|---|---|"]
    for name, field in model.model_fields.items():
        if name in leave_out:
            continue
        bounds = _bounds(field)
        kind = _type(field.annotation) + (f" {bounds}" if bounds else "")
        text = _meaning(model, name, field).replace("|", "\\|")
        lines.append(f"| `{name}` | {kind} | {_default(field)} | {text} |")
    return lines


def scenario_tables() -> str:
    """Every table of a scenario file."""
    lines: list[str] = []
    tables: tuple[tuple[str, type[BaseModel]], ...] = (*TABLES, TRIP)
    for title, model in tables:
        lines += [f"**{title if title[0] != '[' else f'`{title}`'}**", "", *table(model), ""]
    return "\n".join(lines)


def end_reasons() -> str:
    """The names that ``expect_reason`` may give, by status."""
    lines = ["| `expect` | `expect_reason` |", "|---|---|"]
    for status, names in END_REASONS.items():
        if names:
            lines.append(f"| `{status}` | {', '.join(f'`{name}`' for name in names)} |")
    return "\n".join(lines)


def event_tables() -> str:
    """Every kind of event."""
    common = table(events._Event)
    lines = ["All events:", "", *common, ""]
    for model in EVENTS:
        kind = get_args(model.model_fields["type"].annotation)[0]
        lines += [f'**`type = "{kind}"`** {inspect.cleandoc(model.__doc__ or "")}', ""]
        lines += [*table(model, ("type", "t", "tick")), ""]
    return "\n".join(lines)


def law_tables() -> str:
    """Every table of a law file."""
    lines: list[str] = []
    for title, model in LAW_TABLES:
        shown = f"`{title}`" if title[0] == "[" else title
        lines += [f"**{shown}**", "", *table(model), ""]
    return "\n".join(lines)
