"""gfmhil design share: stability of a network against the share of its grid-forming converters."""

import argparse
from typing import Any

from rich.markup import escape

from gfm_hil.api.plot import forming_shares as draw
from gfm_hil.cli.common import print_result, watching
from gfm_hil.cli.design.common import add_figure, save_figure
from gfm_hil.results.table import Table
from gfm_hil.scenario import load_scenario
from gfm_hil.studies.forming_share import BEST, FOLLOWING, FormingShare, forming_shares

_PARTS = 3  # of a mode that the table names


def add(kinds: Any) -> None:
    text = "stability of a network while one converter after the other follows the grid"
    command = kinds.add_parser("share", help=text, description=f"{text} (linear model)")
    command.add_argument("scenario", help="scenario with a network, file or shipped name")
    command.add_argument(
        "--law", default=FOLLOWING, help="of those that follow (default: %(default)s)"
    )
    which = command.add_mutually_exclusive_group()
    which.add_argument(
        "--order", default="", metavar="LIST",
        help="the converters that follow first, by commas; in the order of the network by default",
    )  # fmt: skip
    which.add_argument(
        "--best", action="store_true",
        help="each time the one that leaves the largest sigma least",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="as JSON")
    add_figure(command)
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    scenario = load_scenario(options.scenario, in_process=True)
    order = BEST if options.best else [name for name in options.order.split(",") if name]
    with watching("share of grid-forming") as watch:
        each = forming_shares(scenario, options.law, order, watch)
    save_figure(options, lambda: draw(each, scenario.title))
    content = {
        "scenario": scenario.title, "law": options.law, "shares": [one.plain() for one in each]
    }  # fmt: skip
    title = f"[bold]{escape(options.law)}[/] · {escape(scenario.title)}"
    why = [escape(f"{100 * one.share:.0f} %: {one.reason}") for one in each if one.reason]
    print_result(options, content, [title, _table(each), *why])
    return 0


def _table(each: list[FormingShare]) -> Table:
    rows: list[list[Any]] = []
    for one in each:
        cells: list[Any] = [f"{100 * one.share:.0f} %", one.follows or None]
        if (mode := one.mode) is None:
            rows.append([*cells, "no linear loop", None, None, None])
            continue
        parts = [f"{part} {100 * x:.0f} %" for part, x in [*mode.participation.items()][:_PARTS]
                 if x >= 0.01]  # fmt: skip
        numbers = f"{mode.sigma:.4g}", f"{mode.frequency_hz:.4g}", f"{mode.ratio:.3g}"
        rows.append([*cells, *numbers, ", ".join(parts)])
    heads = ("forming", "now follows", "largest σ [1/s]", "frequency [Hz]", "damping ratio",
             "taking part")  # fmt: skip
    return Table(heads, rows)
