"""gfmhil compare: one scenario under several laws, in one table and one figure."""

import argparse
from collections.abc import Iterator
from typing import Any

from rich.markup import escape

from gfm_hil.api.runs import Comparison, compare
from gfm_hil.cli import common
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.results.report import PAGE, event_rows
from gfm_hil.results.table import Cell, Table


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "In one process and in lockstep, unless --link, --endpoint, --option or "
        "--mode realtime asks for two."
    )
    common.add_scenario_options(command)
    command.add_argument("--laws", help="names separated by commas; the scenario's by default")
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a network: the one that gets each law; by default all, if none has its own",
    )  # fmt: skip
    command.add_argument(
        "--recording", metavar="FILE",
        help="lay a recording of the same beside the runs: CSV, COMTRADE, Parquet, MF4 or MAT",
    )  # fmt: skip
    command.add_argument("--map", metavar="FILE", help="of --recording: what its channels are")
    common.add_open(command)
    common.add_study_options(command, "comparison.json", "<scenario>-compare")


def call(options: argparse.Namespace) -> int:
    """Carry the command out; returns the worst exit code of its runs."""
    asked = options.link__type or options.endpoint or options.option or options.mode == "realtime"
    base = common.resolve(options, in_process=not asked)
    laws = common.split_laws(options.laws) if options.laws else base.compare
    if not laws:
        raise UserError("--laws: the scenario's compare list is empty; name some laws")
    folder = common.new_folder(options.out, f"{common.short_name(options.scenario)}-compare")
    with common.watching("compare", options.quiet) as watch:
        found = compare(
            base, laws, folder, converter=options.converter, recording=options.recording,
            map=options.map, watch=watch,
        )  # fmt: skip
    common.print_result(options, found.summaries, _in_words(found))
    common.show_page(options, folder / PAGE)
    return max(common.exit_code(run) for run in found.values())


def _in_words(found: Comparison) -> Iterator[str | Table]:
    for converter, of in found.converters.items():
        yield from _table(of.summaries, of.events, converter).fitting(terminal())
    reasons = (summary.get("unstable_mode") for summary in found.summaries.values())
    yield from map(escape, filter(None, reasons))


def _table(
    summaries: dict[str, dict[str, Any]], events: list[dict[str, Any]], converter: str
) -> Table:
    rows: list[list[Any]] = [["status", *(s["status"] for s in summaries.values())]]
    for k, event in enumerate(events):
        rows.append([Cell(f"{event['label']} @ {event['t']:g} s", "head")])
        same = [s["events"][k] if k < len(s["events"]) else {} for s in summaries.values()]
        for key, title in event_rows(same):
            if key not in ("label", "t"):
                rows.append(["  " + title, *(e.get(key) for e in same)])
    return Table([converter, *summaries], rows)
