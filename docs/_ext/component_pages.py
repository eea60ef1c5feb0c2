"""The section on the plant's components: parameters from the models that check them, states and
breakers from plants that are built with and without each, columns from the recording's table."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from _ext.scenario_pages import table
from pydantic import BaseModel

from gfm_hil.core.terminal import markdown
from gfm_hil.recording.columns import TABLE
from gfm_plant import Network, NetworkParts, Plant, make_network, options
from gfm_plant.circuit import GROUND
from gfm_plant.components import COMPONENTS, FiniteGrid
from gfm_plant.parameters import ConverterParameters

_NAME = "x"


@dataclass(frozen=True)
class _Entry:
    """What is said of a component, as ``Component`` declares it.

    Attributes:
        title: of its part of the page.
        model: which checks its parameters.
        where: the tables of files that have them.
        example: what makes one named x, as ``NetworkParts`` has it.
        more: states beside those of the circuit: name, unit, meaning.
        columns: of the recording, besides those that every run has of its converters.
        how_many: there can be.
    """

    title: str
    model: type[BaseModel]
    where: str
    how_many: str
    example: Mapping[str, Any] = field(default_factory=dict)
    more: Sequence[tuple[str, str, str]] = ()
    columns: Sequence[str] = ()


ENTRIES = (
    _Entry(
        "Converter: bridge, filter, DC link and line", ConverterParameters,
        "a converter file; `plant.factors` change its elements", "one or more",
        more=(
            ("v_dc", "p.u.", "voltage of the DC capacitor, Eq. (8)"),
            ("delta", "rad", "angle of its frame ahead of the grid's"),
            ("v_dc, p, q, V as sensed", "p.u.", "low-pass of each sensor, with a bandwidth"),
        ),
        columns=tuple(name for name in TABLE if name.startswith("true_")
                      and name not in ("true_omega_g", "true_V_g", "true_i_dc")),
    ),
    _Entry(
        "Second inductor of the filter", options.SecondInductor, "`[plant.lcl]`",
        "one a converter; its current is that of the converter's line",
    ),
    _Entry(
        "DC source", options.DcSource, "`[plant.dc_source]`", "one a converter",
        more=(
            ("integral of the regulator", "p.u.", "of a `regulated` source"),
            ("i_dc", "p.u.", "of a source with a lag `tau_s`"),
        ),
        columns=("true_i_dc",),
    ),
    _Entry(
        "Grid", options.Grid, "`[plant.grid]`; of a network at the node `network.grid`", "one",
        columns=("true_omega_g", "true_V_g"),
    ),
    *(
        _Entry(kind.title, kind, where, kind.how_many, kind.example, kind.more_states, kind.columns)
        for where, kind in (
            ("`[plant.grid.finite]`", FiniteGrid),
            *((f"`[network.{table}.NAME]`", kind) for table, kind in COMPONENTS.items()),
        )
    ),
)  # fmt: skip


def _built(parts: dict[str, Any]) -> Network:
    return make_network(
        {"A": (Plant(), "bus"), "B": (Plant(), "bus")}, 1e-4, Plant().grid,
        NetworkParts.model_validate(parts),
    )  # fmt: skip


def _states(one: _Entry) -> list[str]:
    """A line for each state: those of the circuit are space vectors, two numbers each."""
    plant = _built(one.example)
    if one.model is ConverterParameters:
        names = {f"`{name}`": name for name in plant.wiring.units[0].states}
    else:
        names = {f"`{n}`": n for n in plant.wiring.order if n.partition(".")[0] == _NAME}
    banks = {bank.name for bank in plant.wiring.capacitors}
    banks |= {unit.states[1] for unit in plant.wiring.units}
    lines = []
    for shown, name in names.items():
        what = "voltage" if name in banks else "current"
        lines.append(f"- {shown}: {what}, a space vector, p.u. of the first converter")
    return lines + [f"- {name}: {text}, {unit}" for name, unit, text in one.more]


def _breaker(one: _Entry) -> str:
    """What switches it."""
    if one.model is ConverterParameters:
        return (
            "`breaker` with the name of the converter opens its line; a synchro-check may close it."
        )
    if one.model is options.SecondInductor:
        return "`breaker` with the name of the converter, in a network."
    if one.model in (options.Grid, FiniteGrid):
        return "`grid-breaker`; a synchro-check may close it."
    breakers = _built(one.example).wiring.breakers()
    if _NAME not in breakers:
        return "none"
    checked = "" if GROUND in breakers[_NAME] else " A synchro-check may close it."
    return f"`breaker` with its name.{checked}"


def _terminals(one: _Entry) -> list[str]:
    """Where a run may record it."""
    parts = NetworkParts.model_validate(one.example)
    each = {name: found for _, name, found in parts.components()}
    return [end.name for end in each[_NAME].terminals(_NAME)] if _NAME in each else []


def components() -> str:
    """Every component: what it is, its parameters, states, breaker and columns."""
    lines = []
    for one in ENTRIES:
        lines += [f"### {one.title}", "", inspect.cleandoc(one.model.__doc__ or "")]
        lines += ["", f"Where: {one.where}. How many: {one.how_many}.", "", table(one.model), ""]
        states = _states(one)
        lines += ["States:", "", *(states or ["- none"]), ""]
        lines += [f"Breaker: {_breaker(one)}", ""]
        if ends := _terminals(one):
            named = " and ".join(f"`{end}`" for end in ends)
            lines += [f"Where `network.record` names it: power and current of {named}.", ""]
        if one.columns:
            known_as = {name: TABLE[name] for name in one.columns}
            rows = [(f"`{n}`", row.unit or "–", row.quantity) for n, row in known_as.items()]
            lines += [markdown(("column", "unit", ""), rows), ""]
    return "\n".join(lines)
