"""The components of a network, one a file, and their registry, `NetworkParts`.

A new component is a file here and a field there.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, get_args

from pydantic import Field

from gfm_plant.components.bergeron_line import BergeronLine
from gfm_plant.components.capacitor_bank import CapacitorBank
from gfm_plant.components.constant_power import ConstantPowerLoad
from gfm_plant.components.finite_grid import FiniteGrid
from gfm_plant.components.grid_following import GridFollowing
from gfm_plant.components.induction_motor import InductionMotor
from gfm_plant.components.line import Line
from gfm_plant.components.load import Load
from gfm_plant.components.machine import Machine
from gfm_plant.components.part import FAULT, Component, Dynamic, Fed, Terminal, converter_terminal
from gfm_plant.components.plant_controller import PlantController
from gfm_plant.components.saturation import Saturation
from gfm_plant.components.synchronous_machine import SynchronousMachine
from gfm_plant.components.transformer import Transformer
from gfm_plant.parameters import Options
from gfm_runtime.by_address import call_at
from gfm_runtime.compiled import inlined, inlined_as


class NetworkParts(Options):
    """What connects several converters, by its names."""

    grid: str | None = Field(
        None, min_length=1, description="node of the grid of plant.grid; an island if none"
    )
    record: list[str] = Field(
        [],
        description="whose currents and powers the run records: names of converters and of what "
        'follows, or all of a table, such as "lines"; "converters", "grid", "fault", or "all"',
    )
    lines: dict[str, Line] = Field({}, description="between nodes, by name")
    bergeron_lines: dict[str, BergeronLine] = Field({}, description="between nodes, by name")
    transformers: dict[str, Transformer] = Field({}, description="between nodes, by name")
    saturations: dict[str, Saturation] = Field({}, description="of transformers, by name")
    loads: dict[str, Load] = Field({}, description="by name")
    constant_power: dict[str, ConstantPowerLoad] = Field({}, description="by name")
    grid_following: dict[str, GridFollowing] = Field({}, description="by name")
    capacitors: dict[str, CapacitorBank] = Field({}, description="by name")
    machines: dict[str, Machine] = Field({}, description="by name")
    synchronous_machines: dict[str, SynchronousMachine] = Field({}, description="by name")
    induction_motors: dict[str, InductionMotor] = Field({}, description="by name")
    plant_controllers: dict[str, PlantController] = Field({}, description="by name")

    def components(self) -> Iterator[tuple[str, str, Component]]:
        """Table, name and options of each, in the order of the fields above."""
        for table in COMPONENTS:
            for name, one in getattr(self, table).items():
                yield table, name, one

    def recorded(self, converters: Mapping[str, str]) -> tuple[Terminal, ...]:
        """What ``record`` names, in the order of the network, and where its plant controllers
        measure.

        Args:
            converters: their nodes by their names.

        Raises:
            ValueError: a name is unknown, or of something without a current of its own; a plant
                controller has no place to measure.
        """
        each = {("converters", n): [converter_terminal(n, at)] for n, at in converters.items()}
        each |= {(table, n): [*one.terminals(n)] for table, n, one in self.components()}
        ends = {n: terminals for (_, n), terminals in each.items() if len(terminals) == 2}
        measured = {
            ("plant_controllers", n): [one.measures(n, ends)]
            for n, one in self.plant_controllers.items()
        }
        each |= measured
        if self.grid is not None:
            each["grid", "grid"] = [Terminal("grid", self.grid)]
        each[FAULT, FAULT] = [Terminal(FAULT, "")]
        each = {key: terminals for key, terminals in each.items() if terminals}
        names, asked = {name for _, name in each}, {*self.record}
        known = sorted(names) + sorted({table for table, _ in each} - names) + ["all"]
        if unknown := [name for name in self.record if name not in known]:
            raise ValueError(f"record = {unknown[0]!r}: must be one of {known}")
        return tuple(
            terminal
            for (table, name), terminals in each.items()
            if "all" in asked
            or name in asked
            or (table in asked and table not in names)
            or (table, name) in measured
            for terminal in terminals
        )


COMPONENTS: dict[str, type[Component]] = {
    table: get_args(field.annotation)[1]
    for table, field in NetworkParts.model_fields.items()
    if table not in ("grid", "record")
}
"""The components by their tables."""

_FED = [kind for kind in COMPONENTS.values() if issubclass(kind, Fed)]
_OTHERS = [x for x in COMPONENTS.values() if issubclass(x, Dynamic) and not issubclass(x, Fed)]
DYNAMIC: tuple[type[Dynamic], ...] = (
    FiniteGrid, *sorted(_FED, key=lambda kind: not kind.is_voltage), *_OTHERS
)  # fmt: skip
"""The components with records, in the order of these: voltages before currents, then what has no
source."""


def _every(hook: str) -> Any:
    """A compiled function (plant, c, part) that calls a hook of all components, in turn."""

    def last(plant: Any, c: int, part: int) -> None:
        return

    chain = inlined_as(f"every_{hook}", last)
    for k, kind in reversed([*enumerate(DYNAMIC)]):
        if hook in kind.hooks:
            chain = _link(hook, kind.hooks[hook], k, chain)

    def first(plant: Any, c: int, part: int) -> None:
        if plant.net[0].n_dynamic > 0:  # a plant without any asks once, not of each kind
            chain(plant, c, part)

    return inlined_as(f"every_{hook}_there_is", first)


def _link(hook: str, call: Callable[..., None], k: int, others: Callable[..., None]) -> Any:
    def link(plant: Any, c: int, part: int) -> None:
        those = plant.parts[k]
        for j in range(len(those)):
            call(plant.net[0], plant.now[0], those[j], c, part)
        others(plant, c, part)

    return inlined_as(f"every_{hook}_{k}", link)


every_at_rest, every_flow = _every("at_rest"), _every("flow")
every_begin, every_drive = _every("begin"), _every("drive")
every_middle, every_end = _every("middle"), _every("end")
_every_keep, _every_go_back, _every_tick = _every("keep"), _every("go_back"), _every("tick")

KEEP, GO_BACK, TICK = range(3)
"""What all components do around a sampling period, see ``Dynamic.hooks``."""


@inlined
def components_act(plant: Any, act: int, c: int) -> None:
    """Have all components keep their states, go back to them, or end a period, in circuit c."""
    if act == KEEP:
        _every_keep(plant, c, 0)
    elif act == GO_BACK:
        _every_go_back(plant, c, 0)
    else:
        _every_tick(plant, c, 0)


@inlined
def call_components(plant: Any, act: int, c: int) -> None:
    """Call ``components_act`` by its address, of a plant that has components."""
    if plant.net[0].n_dynamic > 0:
        call_at(plant.net[0].components, plant.net[0].records, act, c)
