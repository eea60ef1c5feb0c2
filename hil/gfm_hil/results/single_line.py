"""Where the parts of a single-line diagram stand: nodes in columns, each with its rows."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

from gfm_hil.recording.run import nominal_frequency
from gfm_hil.scenario import Scenario
from gfm_plant import Plant
from gfm_runtime import law_titles


@dataclass
class Bar:
    """The busbar of a node: converters on its left, and on its right what is connected in shunt."""

    column: int = 0
    converters: list[str] = field(default_factory=list)
    right: list[tuple[str, str, bool]] = field(default_factory=list)  # symbol, text, closed
    rows: list[int] = field(default_factory=list)


@dataclass
class DrawnLine:
    """What lies between two nodes, ``ends``, in a row of its own."""

    ends: tuple[str, str]
    symbol: str
    text: str
    closed: bool
    row: int = 0


Lines = dict[str, DrawnLine]  #: by name


def converters_of(scenario: Scenario) -> tuple[dict[str, Plant], dict[str, str], dict[str, str]]:
    """The plant, what results call the law, and the node of each converter, by its name."""
    if scenario.network is None:
        return {"": scenario.plant}, {"": law_titles([scenario.law])[scenario.law]}, {"": ""}
    each = scenario.each
    nodes = {name: member.node for name, member in scenario.network.converters.items()}
    titles = law_titles(s.law for s in each.values())
    laws = {name: titles[s.law] for name, s in each.items()}
    return {name: s.plant for name, s in each.items()}, laws, nodes


def bars_of(scenario: Scenario, nodes: Mapping[str, str]) -> tuple[dict[str, Bar], Lines]:
    """The nodes with what is at them, and the lines between them."""
    bars: dict[str, Bar] = {}
    for converter, node in nodes.items():
        bars.setdefault(node, Bar()).converters.append(converter)
    grid, network = scenario.plant.grid, scenario.network
    lines: Lines = {}
    at_grid: str | None = next(iter(bars))
    if network is None:
        if grid.load_R is not None:
            text = f"local load\nR {grid.load_R:g} Ω, L {1e3 * (grid.load_L or 0.0):g} mH"
            bars[next(iter(bars))].right.append(("load", text, True))
    else:
        at_grid = network.grid
        each = [(name, one, getattr(one, "closed", True)) for _, name, one in network.components()]
        for name, one, closed in each:
            if hasattr(one, "start") and hasattr(one, "end"):
                lines[name] = DrawnLine((one.start, one.end), one.symbol, one.label(), closed)
        for line in lines.values():
            for node in line.ends:
                bars.setdefault(node, Bar())
        for name, one, closed in sorted(each, key=lambda item: item[1].symbol == "capacitor"):
            if hasattr(one, "node"):  # banks below the others
                shunt = one.symbol, f"{name}\n{one.label()}", closed
                bars.setdefault(one.node, Bar()).right.append(shunt)
    if at_grid is not None:
        kind = "ideal" if grid.finite is None else f"S {grid.finite.S:g}, H {grid.finite.H:g} s"
        f_g = grid.omega_g * nominal_frequency(scenario)
        text = f"grid, {kind}\n$V_g$ {grid.V_g:g} p.u., {f_g:g} Hz"
        bars.setdefault(at_grid, Bar()).right.insert(0, ("~", text, True))
    _assign_columns(bars, lines, at_grid)
    return bars, lines


def _assign_columns(bars: Mapping[str, Bar], lines: Lines, last: str | None) -> None:
    """Put every node left of its neighbours on the way to the grid, which is last; those that a
    line connects are in different columns."""
    first = last or next(iter(bars))
    away, front = {first: 0}, [first]
    for here in front:
        for start, end in (line.ends for line in lines.values()):
            other = {start: end, end: start}.get(here)
            if other is not None and other not in front:
                front.append(other)
    for k, name in enumerate(front[1:], 1):
        beside = {node for line in lines.values() if name in line.ends for node in line.ends}
        away[name] = 1 + max(away[other] for other in front[:k] if other in beside)
    for name, bar in bars.items():
        bar.column = max(away.values()) - away.get(name, 0)


def assign_rows(bars: Mapping[str, Bar], lines: Lines, stacked: bool = False) -> int:
    """Assign rows of their own to every node and line; returns how many there are.

    Nodes at the right come first, so that wires to them pass above the others. ``stacked``: all
    nodes are in one column for a narrow page, with its converters on the right, above the rest.
    """
    row, done = 0, set[str]()
    for name, bar in sorted(bars.items(), key=lambda item: -item[1].column):
        for line in lines.values():
            if done.intersection(line.ends) and name in line.ends:
                line.row = row
                row += 1
        own = len(bar.converters), len(bar.right)
        count = max(1, sum(own) if stacked else max(own))
        bar.rows = [*range(row, row + count)]
        row += count
        done.add(name)
    return row


def collide(bars: Mapping[str, Bar], lines: Lines) -> bool:
    """Whether two nodes of a column would share rows, which have them, as in meshes: their bars
    would look like one."""
    taken: dict[int, list[tuple[int, int]]] = {}
    for name, bar in bars.items():
        rows = [*bar.rows, *(line.row for line in lines.values() if name in line.ends)]
        taken.setdefault(bar.column, []).append((min(rows), max(rows)))
    return any(
        later[0] <= earlier[1]
        for column in map(sorted, taken.values())
        for earlier, later in pairwise(column)
    )


def assign_lanes(bars: Mapping[str, Bar], lines: Lines) -> dict[str, int]:
    """How far left of nodes that are stacked each line runs, 0 next to them, so that no two meet
    but at a node."""
    ends = {name: sorted(bars[node].rows for node in line.ends) for name, line in lines.items()}
    taken: list[list[tuple[int, int]]] = []  # of each lane, from row to row
    lanes = {}
    for name in sorted(lines, key=lambda name: ends[name][1][0] - ends[name][0][-1]):
        top, low = ends[name][0][-1], ends[name][1][0]
        fits = (k for k, lane in enumerate(taken) if all(low <= a or b <= top for a, b in lane))
        lanes[name] = next(fits, len(taken))
        if lanes[name] == len(taken):
            taken.append([])
        taken[lanes[name]].append((top, low))
    return lanes
