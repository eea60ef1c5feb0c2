"""gfmhil design clearing: how long a fault or a sag may last, on one grid or on several."""

import argparse
import json
from dataclasses import asdict
from typing import Any

from gfm_hil.api.design import at_short_circuit_ratios
from gfm_hil.api.plot import clearing_times
from gfm_hil.cli.common import numbers, watching
from gfm_hil.cli.design.common import add_figure, add_loop_options, chosen_scenario, save_figure
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.report import finite
from gfm_hil.results.table import Table
from gfm_hil.studies.clearing import AFTER_S, LONGEST_S, ClearingTime, clearing_time


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
        "--longest", metavar="S", type=float, default=LONGEST_S, help="tried (default: %(default)s)"
    )
    command.add_argument(
        "--after", metavar="S", type=float, default=AFTER_S,
        help="how long a run goes on after the fault (default: %(default)s)",
    )  # fmt: skip
    command.add_argument(
        "--within", metavar="S", type=float, help="resolution; one tick by default"
    )
    add_figure(command)


def call(options: argparse.Namespace) -> int:
    """Find the times and print them; exit code 0 also where there is none."""
    scenario = chosen_scenario(options.scenario, options)
    if options.scr and scenario.network is not None:
        raise UserError("--scr: is that of one converter's grid; the scenario has a network")
    if options.out and not options.scr:
        raise UserError("--out: the figure is one over --scr")
    made = list[ClearingTime]()
    how = options.longest, options.after, options.within
    with watching("clearing") as watch:
        for one in at_short_circuit_ratios(scenario, options.scr):
            made.append(clearing_time(one, *how, watch))
    ratios = options.scr or [None]
    if options.out:
        save_figure(options.out, lambda: clearing_times(made, options.scr))
    if options.json:
        rows = [{"scr": scr, **asdict(one)} for scr, one in zip(ratios, made, strict=True)]
        print(json.dumps(finite(rows), indent=2))
        return 0
    console = terminal(highlight=False)
    console.print(f"[bold]{scenario.law}[/] · {scenario.title}")
    cells = [
        [
            "its own" if scr is None else f"{scr:g}",
            one.seconds,
            one.loss or "borne",
            len(one.trials),
        ]
        for scr, one in zip(ratios, made, strict=True)
    ]
    console.print(Table(["SCR", "bears [s]", "a longer one", "runs"], cells, text=0))
    if options.out:
        console.print(f"figure: {options.out}", soft_wrap=True)
    return 0
