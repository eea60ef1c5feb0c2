"""gfmhil design clearing: how long a fault or a sag may last, at one place or over a map."""

import argparse
import json
from dataclasses import asdict
from typing import Any

from gfm_hil.api import plot
from gfm_hil.api.clearing_map import SCR, WITHIN_S, clearing_map
from gfm_hil.cli.common import numbers, watching
from gfm_hil.cli.design.common import add_figure, add_loop_options, chosen_scenario, save_figure
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.report import finite
from gfm_hil.results.table import Table
from gfm_hil.studies.clearing import AFTER_S, LONGEST_S, clearing_time


def add(kinds: Any) -> None:
    text = "how long the fault or the sag of a scenario may last before the converter is lost"
    command = kinds.add_parser("clearing", help=text, description=f"{text}, by runs")
    add_loop_options(command)
    command.set_defaults(scenario="deep_sag", call=call)
    command.add_argument(
        "--scr", metavar="LIST", type=numbers, default=[],
        help="short-circuit ratios by commas; that of the scenario by default",
    )  # fmt: skip
    command.add_argument(
        "--over", metavar="KEY=LIST", type=_quantity, action="append", default=[],
        help="values of a key of the scenario, e.g. events.0.V_g=0.1,0.2, or of its inner stage,"
        " as inner.I_max=1.1,1.2; may be repeated, with --scr for a map of up to three",
    )  # fmt: skip
    command.add_argument(
        "--longest", metavar="S", type=float, default=LONGEST_S, help="tried (default: %(default)s)"
    )
    command.add_argument(
        "--after", metavar="S", type=float, default=AFTER_S,
        help="how long a run goes on after the fault (default: %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "--within", metavar="S", type=float,
        help=f"resolution; one tick by default, {WITHIN_S:g} of a map",
    )  # fmt: skip
    command.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
    add_figure(command)


def _quantity(text: str) -> tuple[str, list[float]]:
    """KEY=LIST."""
    name, equals, values = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"{text!r}: must be KEY=LIST, e.g. events.0.V_g=0.1,0.2")
    return name, numbers(values)


def call(options: argparse.Namespace) -> int:
    """Find the times and print them; exit code 0 also where there is none."""
    scenario = chosen_scenario(options.scenario, options)
    over = ({SCR: options.scr} if options.scr else {}) | dict(options.over)
    if options.out and not over:
        raise UserError("--out: the figure is one over --scr or --over")
    how: dict[str, Any] = {"longest": options.longest, "after": options.after}
    console = terminal(highlight=False)
    with watching("clearing") as watch:
        if not over:
            one = clearing_time(scenario, **how, within=options.within, watch=watch)
            rows = [{"scr": None, **asdict(one)}]
        else:
            within = options.within or WITHIN_S
            how |= {"within": within, "workers": options.workers}
            found = clearing_map(None, scenario, over=over, watch=watch, **how)
            rows = found.rows()
            if options.out:
                save_figure(options.out, lambda: plot.clearing_map(found))
    if options.json:
        print(json.dumps(finite(rows), indent=2))
        return 0
    console.print(f"[bold]{scenario.law}[/] · {scenario.title}")
    console.print(_table(list(over), rows))
    if options.out:
        console.print(f"figure: {options.out}", soft_wrap=True)
    return 0


def _table(over: list[str], rows: list[dict[str, Any]]) -> Table:
    heads = [
        *("SCR" if name == SCR else name for name in over),
        "bears [s]",
        "a longer one",
        "runs",
    ]
    cells = [
        [*(f"{row[name]:g}" for name in over), row["seconds"], row["loss"] or "borne",
         row["runs"] if over else len(row["trials"])]
        for row in rows
    ]  # fmt: skip
    return Table(heads, cells, text=0)
