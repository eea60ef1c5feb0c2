"""The page of the plant's components: parameters from the models that check them, states and
breakers from plants that are built with and without each, columns from the recording's table."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from typing import Any

from _ext.scenario_pages import table
from pydantic import BaseModel

from gfm_hil.core.terminal import markdown
from gfm_hil.recording.columns import TABLE
from gfm_plant import Network, NetworkParts, Plant, make_network, options
from gfm_plant.circuit import GROUND
from gfm_plant.parameters import ConverterParameters
from gfm_plant.records import N_MACHINES, N_SINKS, SIZES
from gfm_plant.wiring import MAGNETISING

_NAME = "x"


@dataclass(frozen=True)
class _Component:
    """What is said of a component.

    Attributes:
        title: of its part of the page.
        model: which checks its parameters.
        where: the tables of files that have them.
        example: what makes one named x, as ``NetworkParts`` has it.
        more: states beside those of the circuit: name, unit, meaning.
        columns: of the recording, besides those that every run has of its converters.
        most: how many fit.
    """

    title: str
    model: type[BaseModel]
    where: str
    example: dict[str, Any] = field(default_factory=dict)
    more: tuple[tuple[str, str, str], ...] = ()
    columns: tuple[str, ...] = ()
    most: str = ""


_CIRCUIT = f"all together at most {max(SIZES.values())} currents and voltages of the circuit"
_AT = {"node": "bus"}
COMPONENTS = (
    _Component(
        "Converter: bridge, filter, DC link and line", ConverterParameters,
        "a converter file; `plant.factors` change its elements",
        more=(
            ("v_dc", "p.u.", "voltage of the DC capacitor, Eq. (8)"),
            ("delta", "rad", "angle of its frame ahead of the grid's"),
            ("v_dc, p, q, V as sensed", "p.u.", "low-pass of each sensor, with a bandwidth"),
        ),
        columns=tuple(name for name in TABLE if name.startswith("true_")
                      and name not in ("true_omega_g", "true_V_g", "true_i_dc")),
        most=f"1 to {max(SIZES)}",
    ),
    _Component(
        "Second inductor of the filter", options.SecondInductor, "`[plant.lcl]`",
        most="one a converter; its current is that of the converter's line",
    ),
    _Component(
        "DC source", options.DcSource, "`[plant.dc_source]`",
        more=(
            ("integral of the regulator", "p.u.", "of a `regulated` source"),
            ("i_dc", "p.u.", "of a source with a lag `tau_s`"),
        ),
        columns=("true_i_dc",), most="one a converter",
    ),
    _Component(
        "Grid", options.Grid, "`[plant.grid]`; of a network at the node `network.grid`",
        columns=("true_omega_g", "true_V_g"), most="one",
    ),
    _Component(
        "Grid that reacts", options.FiniteGrid, "`[plant.grid.finite]`",
        more=(
            ("omega_g", "p.u.", "its frequency, by the swing equation"),
            ("P_turbine", "p.u. of its rating", "power of its turbines, behind the governor"),
        ),
        columns=("true_omega_g",), most="one",
    ),
    _Component(
        "Line", options.Line, "`[network.lines.NAME]`",
        {"lines": {_NAME: {"start": "bus", "end": "n", "L": 0.1}},
         "loads": {"r": {"node": "n", "P": 0.1}}}, most=_CIRCUIT,
    ),
    _Component(
        "Transformer", options.Transformer, "`[network.transformers.NAME]`",
        {"transformers": {_NAME: {"start": "bus", "end": "n", "S": 1.0, "X": 0.1, "X_m": 50.0}},
         "loads": {"r": {"node": "n", "P": 0.1}}}, most=_CIRCUIT,
    ),
    _Component(
        "Load with P and Q", options.Load, "`[network.loads.NAME]`",
        {"loads": {_NAME: {**_AT, "P": 0.1, "Q": 0.1}}}, most=_CIRCUIT,
    ),
    _Component(
        "Load without Q: a resistor", options.Load, "`[network.loads.NAME]`",
        {"loads": {_NAME: {**_AT, "P": 0.1}}}, most="one a node",
    ),
    _Component(
        "Load of constant power", options.ConstantPowerLoad, "`[network.constant_power.NAME]`",
        {"constant_power": {_NAME: {**_AT, "P": 0.1}}, "capacitors": {"c": {**_AT, "Q": 0.1}}},
        more=(("v_f", "p.u., a space vector", "the voltage that it has measured"),),
        most=str(N_SINKS),
    ),
    _Component(
        "Capacitor bank", options.CapacitorBank, "`[network.capacitors.NAME]`",
        {"capacitors": {_NAME: {**_AT, "Q": 0.1}}}, most=f"one a node; {_CIRCUIT}",
    ),
    _Component(
        "Synchronous machine", options.Machine, "`[network.machines.NAME]`",
        {"machines": {_NAME: {**_AT, "S": 1.0, "H": 3.0, "P": 0.2}}},
        more=(
            ("omega", "p.u.", "its speed, by the swing equation"),
            ("angle", "rad", "of the voltage behind its reactance"),
            ("P_turbine", "p.u. of its rating", "power of its turbine, behind the governor"),
        ),
        columns=("true_omega_g",), most=str(N_MACHINES),
    ),
)  # fmt: skip


def _built(parts: dict[str, Any]) -> Network:
    return make_network(
        {"A": (Plant(), "bus"), "B": (Plant(), "bus")}, 1e-4, Plant().grid,
        NetworkParts.model_validate(parts),
    )  # fmt: skip


def _states(one: _Component) -> list[str]:
    """A line for each state: those of the circuit are space vectors, two numbers each."""
    plant = _built(one.example)
    if one.model is ConverterParameters:
        names = {f"`{name}`": name for name in plant.wiring.units[0].states}
    else:
        own = (_NAME, _NAME + MAGNETISING)
        names = {f"`{name}`": name for name in plant.wiring.order if name in own}
    banks = {bank.name for bank in plant.wiring.capacitors}
    banks |= {unit.states[1] for unit in plant.wiring.units}
    lines = []
    for shown, name in names.items():
        what = "voltage" if name in banks else "current"
        lines.append(f"- {shown}: {what}, a space vector, p.u. of the first converter")
    return lines + [f"- {name}: {text}, {unit}" for name, unit, text in one.more]


def _breaker(one: _Component) -> str:
    """What switches it."""
    if one.model is ConverterParameters:
        return (
            "`breaker` with the name of the converter opens its line; a synchro-check may close it."
        )
    if one.model is options.SecondInductor:
        return "`breaker` with the name of the converter, in a network."
    if one.model in (options.Grid, options.FiniteGrid):
        return "`grid-breaker`; a synchro-check may close it."
    breakers = _built(one.example).wiring.breakers()
    if _NAME not in breakers:
        return "none"
    checked = "" if GROUND in breakers[_NAME] else " A synchro-check may close it."
    return f"`breaker` with its name.{checked}"


def components() -> str:
    """Every component: what it is, its parameters, states, breaker and columns.

    Raises:
        KeyError: a part of a network is missing here.
    """
    known = {key for one in COMPONENTS for key in one.example}
    if missing := {*NetworkParts.model_fields} - known - {"grid"}:
        raise KeyError(f"{sorted(missing)}: not among the components")
    lines = []
    for one in COMPONENTS:
        lines += [f"## {one.title}", "", inspect.cleandoc(one.model.__doc__ or "")]
        lines += ["", f"Where: {one.where}. How many: {one.most}.", "", table(one.model), ""]
        states = _states(one)
        lines += ["States:", "", *(states or ["- none"]), ""]
        lines += [f"Breaker: {_breaker(one)}", ""]
        if one.columns:
            known_as = {name: TABLE[name] for name in one.columns}
            rows = [(f"`{n}`", row.unit or "–", row.quantity) for n, row in known_as.items()]
            lines += [markdown(("column", "unit", ""), rows), ""]
    return "\n".join(lines)
