"""gfmhil design clearing and attraction: how long a fault may last, and from which angles a
converter comes back, at one place or over a map."""

import argparse
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from gfm_hil.api import plot
from gfm_hil.api.transients import SCR, WITHIN_S, attraction_map, clearing_map
from gfm_hil.cli.common import add_workers, numbers, print_result, watching, workers_of
from gfm_hil.cli.design.common import add_figure, add_loop_options, chosen_scenario, save_figure
from gfm_hil.core.errors import UserError
from gfm_hil.results.table import Table
from gfm_hil.studies import attraction, clearing

Row = dict[str, Any]
Columns = dict[str, Callable[[Row], Any]]


def _reason(row: Row, key: str, none: str) -> str:
    """A reason without its numbers; ``none`` if there is no reason."""
    return row[key].partition(":")[0] or none


#: what is told of a ``row``, by its head
_CLEARING: Columns = {
    "bears [s]": lambda row: row["seconds"] if row["loss"] else f"≥ {row['seconds']:g}",
    "a longer one": lambda row: _reason(row, "loss", "not tried"),
}
_ATTRACTION: Columns = {
    "back from [deg]": lambda row: row["low"],
    "to [deg]": lambda row: row["high"],
    "a larger jump back": lambda row: _reason(row, "below", "comes back"),
    "a larger one ahead": lambda row: _reason(row, "above", "comes back"),
}


def add(kinds: Any) -> None:
    text = "how long the fault or the sag of a scenario may last before the converter is lost"
    command = _add(kinds, "clearing", text, "deep_sag", clearing.AFTER_S)
    command.add_argument(
        "--longest", metavar="S", type=float, default=clearing.LONGEST_S,
        help="tried (default: %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "--within", metavar="S", type=float,
        help=f"resolution; one tick by default, {WITHIN_S:g} of a map",
    )  # fmt: skip
    command.set_defaults(call=_clearing)
    text = "from which jumps of the grid's angle a converter at rest comes back to where it was"
    command = _add(kinds, "attraction", text, "pref_step", attraction.AFTER_S)
    command.add_argument(
        "--within", metavar="DEG", type=float, default=attraction.WITHIN,
        help="resolution, degrees (default: %(default)s)",
    )  # fmt: skip
    command.set_defaults(call=_attraction)


def _add(kinds: Any, name: str, text: str, scenario: str, after: float) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = kinds.add_parser(
        name, help=text, description=f"{text}, by runs"
    )
    add_loop_options(command, scenario, networks=False)
    command.add_argument(
        "--scr", metavar="LIST", type=numbers, default=[],
        help="short-circuit ratios by commas; that of the scenario by default",
    )  # fmt: skip
    command.add_argument(
        "--over", metavar="KEY=LIST", type=_quantity, action="append", default=[],
        help="values of a key of the scenario, e.g. references.P_ref=0.2,0.8, or of its inner"
        " stage, as inner.I_max=1.1,1.2; may be repeated, with --scr for a map of up to three",
    )  # fmt: skip
    command.add_argument(
        "--after", metavar="S", type=float, default=after,
        help="how long a run goes on afterwards at least (default: %(default)s); one whose angle is"
        " not back by then goes on, to 24 s",
    )  # fmt: skip
    add_workers(command, "1")
    add_figure(command)
    return command


def _quantity(text: str) -> tuple[str, list[float]]:
    """KEY=LIST."""
    name, equals, values = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r}: must be KEY=LIST, e.g. events.0.V_g=0.1,0.2")
    return name, numbers(values)


def _clearing(options: argparse.Namespace) -> int:
    how = {"longest": options.longest, "after": options.after}
    at_map = {**how, "within": options.within or WITHIN_S}
    how["within"] = options.within
    return _tell(options, _CLEARING, clearing.clearing_time, how, clearing_map, at_map,
                 plot.clearing_map)  # fmt: skip


def _attraction(options: argparse.Namespace) -> int:
    how = {"within": options.within, "after": options.after}
    return _tell(options, _ATTRACTION, attraction.attraction, how, attraction_map, how,
                 plot.attraction_map)  # fmt: skip


def _tell(
    options: argparse.Namespace,
    columns: Columns,
    at_one: Callable[..., Any],
    how: dict[str, Any],
    at_map: Callable[..., Any],
    how_map: dict[str, Any],
    draw: Callable[..., object],
) -> int:
    """Find and print; exit code 0 also where nothing is borne."""
    scenario = chosen_scenario(options.scenario, options)
    over = ({SCR: options.scr} if options.scr else {}) | dict(options.over)
    if options.figure and not over:
        raise UserError("--out: the figure is one over --scr or --over")
    with watching(options.design) as watch:
        if not over:
            each = [at_one(scenario, **how, watch=watch)]
            rows = [each[0].row()]
        else:
            found = at_map(
                None, scenario, over=over, workers=workers_of(options, 1), watch=watch, **how_map
            )
            each, rows = found.found, found.rows()
            save_figure(options, lambda: draw(found))
    content = [{SCR: None} | row | asdict(one) for row, one in zip(rows, each, strict=True)]
    heads = ["SCR" if name == SCR else name for name in over]
    cells = [
        [
            *(f"{row[name]:g}" for name in over),
            *(tell(row) for tell in columns.values()),
            row["runs"],
        ]
        for row in rows
    ]
    table = Table([*heads, *columns, "runs"], cells, text=0)
    print_result(options, content, [f"[bold]{scenario.law}[/] · {scenario.title}", table])
    return 0
