"""What the scope's diagram of a network shows: its parts, what the converters do now, and which
breakers are closed."""

from collections.abc import Mapping
from typing import Any

from gfm_hil.ports.scope.watched import WatchedRun
from gfm_hil.results import single_line
from gfm_hil.scenario.events.breaker import GRID, switched
from gfm_runtime.states import STATES

_SHOWN = ("p", "q", "V", "omega_u")  # p.u.; the pyramid has omega_u as a frequency, Hz


class Flows:
    """The diagram of a network and its newest tick, from the runs of its converters by name. Raises
    LawError: a law cannot be read; the diagram has the titles of all."""

    def __init__(self, runs: Mapping[str, WatchedRun]) -> None:
        self._runs = runs
        self._first = next(iter(runs.values()))  # which records what is of the network
        self._scenario = self._first.record.scenario
        _, laws, nodes = single_line.converters_of(self._scenario)
        bars, lines = single_line.bars_of(self._scenario, nodes)
        rows = single_line.assign_rows(bars, lines)
        self._closed = dict.fromkeys(nodes, True) | {n: one.closed for n, one in lines.items()}
        network = self._scenario.network
        assert network is not None
        feeds = {name for _, name, one in network.components() if one.feeds} | {GRID}
        nodes_shown: list[dict[str, Any]] = []
        for name, bar in bars.items():
            shunts = []
            for symbol, text, closed in bar.right:
                part = text.partition("\n")[0] if symbol != "~" else GRID
                self._closed[part] = closed
                shunts.append({"name": part, "symbol": symbol, "feeds": part in feeds})
            nodes_shown.append({
                "name": name, "column": bar.column, "rows": bar.rows,
                "converters": bar.converters, "right": shunts,
            })  # fmt: skip
        self.diagram = {
            "rows": rows, "bars": nodes_shown, "laws": laws,
            "lines": [
                {"name": name, "row": one.row, "start": one.ends[0], "end": one.ends[1],
                 "symbol": one.symbol}
                for name, one in lines.items()
            ],
            "mesh": single_line.collide(bars, lines), "stacked": _stack(bars, lines),
        }  # fmt: skip

    def now(self) -> dict[str, Any]:
        """The newest tick of each converter; P and Q, p.u., of each part that the run records, of a
        line at its start; and whether the breaker of each part is closed."""
        converters = {name: _newest(run) for name, run in self._runs.items()}
        closed = dict(self._closed)
        for entry in self._first.happened()["events"]:
            if (change := switched(entry)) is not None:
                closed[change[0]] = change[1]
        return {"converters": converters, "flows": self._recorded_flows(), "closed": closed}

    def _recorded_flows(self) -> dict[str, list[float]]:
        columns, done = self._first.record.columns, self._first.pyramid.done
        names = [n.removesuffix(".P") for n in self._scenario.flows if n.endswith(".P")]
        if not done:
            return {}
        return {
            name: [round(float(columns[f"{name}.{x}"][done - 1 : done][0]), 5) for x in "PQ"]
            for name in names
            if f"{name}.P" in columns and not name.endswith(".end")
        }


def _stack(bars: Mapping[str, single_line.Bar], lines: single_line.Lines) -> dict[str, Any]:
    """For a narrow page: the rows of each node, and the row and the lane of each line."""
    rows = single_line.assign_rows(bars, lines, stacked=True)
    lanes = single_line.assign_lanes(bars, lines)
    return {
        "rows": rows, "bars": {name: bar.rows for name, bar in bars.items()},
        "lines": {name: (one.row, lanes[name]) for name, one in lines.items()},
    }  # fmt: skip


def _newest(run: WatchedRun) -> dict[str, Any]:
    """The newest tick of a converter: p, q, V in p.u., f in Hz, its state and the misses so far; a
    signal that is not recorded is left out."""
    pyramid, done = run.pyramid, run.pyramid.done
    if not done:
        return {}
    values = {name: float(pyramid.values(name, done - 1, done)[0]) for name in _SHOWN}
    newest: dict[str, Any] = {name: round(x, 5) for name, x in values.items() if x == x}
    state = run.record.columns.get("state")
    if state is not None and 0 <= (code := float(state[done - 1 : done][0])) < len(STATES):
        newest["state"] = STATES[int(code)]
    trip = run.record.columns.get("true_trip")
    if trip is not None and newest.get("state") != "SAFE" and trip[done - 1 : done][0] > 0:
        newest["state"] = "tripped"  # of a controller that is dead or was stopped
    return newest | {"misses": pyramid.misses(done)}
