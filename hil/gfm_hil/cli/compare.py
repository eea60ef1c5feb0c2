"""gfmhil compare: one scenario under several laws, in one table and one figure."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from typing import Any

from rich.markup import escape
from rich.table import Table

from gfm_hil.api.runs import run
from gfm_hil.cli.common import (
    add_scenario_options,
    exit_code,
    new_folder,
    progress_bar,
    resolve,
    split_laws,
    why_it_ended,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.terminal import fitting, numbers, terminal
from gfm_hil.engine.setup import ONE_CONVERTER
from gfm_hil.recording.run import Run
from gfm_hil.results.figures import draw_comparison
from gfm_hil.results.report import cell, event_rows
from gfm_hil.run.run_folder import check_free
from gfm_hil.scenario.model import find_scenario
from gfm_runtime import law_titles


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "In one process and in lockstep, unless --link, --endpoint, --option or "
        "--mode realtime asks for two."
    )
    add_scenario_options(command)
    command.add_argument("--laws", help="names separated by commas; the scenario's by default")
    command.add_argument("-o", "--out", help="folder; runs/<scenario>-compare-<time> by default")
    command.add_argument("--json", action="store_true", help="print the summaries as JSON")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    """Carry the command out; returns the worst exit code of its runs."""
    asked = options.link or options.endpoint or options.option or options.mode == "realtime"
    base = resolve(options, in_process=not asked)
    if base.network is not None:
        raise UserError(f"{options.scenario}: {ONE_CONVERTER}")
    laws = split_laws(options.laws) if options.laws else base.compare
    if not laws:
        raise UserError("--laws: the scenario's compare list is empty; name some laws")
    scenarios = {
        name: resolve(options, in_process=not asked, law=law)
        for law, name in law_titles(laws).items()
    }
    folder = new_folder(options.out, f"{find_scenario(options.scenario).stem}-compare")
    check_free(folder, base.ticks * len(scenarios), base.has_inner)
    runs: dict[str, Run] = {}
    for name, scenario in scenarios.items():
        with progress_bar(scenario, name, options.quiet) as (progress, notice):
            runs[name] = run(scenario, folder=folder / name, progress=progress, notice=notice)
        if runs[name].summary["status"] == "interrupted":
            break
    events = max((one.summary["events"] for one in runs.values()), key=len)
    signals = {name: one.columns for name, one in runs.items() if "true_p" in one.columns}
    if signals:
        draw_comparison(folder / "comparison.png", base, signals, events)
    summaries = {name: one.summary for name, one in runs.items()}
    write_text(folder / "comparison.json", json.dumps(summaries, indent=2) + "\n")
    if options.json:
        print(json.dumps(summaries, indent=2))
    else:
        _print(summaries, events)
        for why in filter(None, map(why_it_ended, runs.values())):
            terminal().print(escape(why), highlight=False, soft_wrap=True)
        terminal().print(f"figure: {folder / 'comparison.png'}", highlight=False, soft_wrap=True)
    return max(exit_code(one) for one in runs.values())


def _print(summaries: dict[str, dict[str, Any]], events: list[dict[str, Any]]) -> None:
    def table_of(names: Sequence[str]) -> Table:
        table = numbers("", *map(escape, names))
        some = [summaries[name] for name in names]
        table.add_row("status", *[s["status"] for s in some])
        for k, event in enumerate(events):
            table.add_row(f"[bold]{escape(event['label'])} @ {event['t']:g} s[/]")
            same = [s["events"][k] if k < len(s["events"]) else {} for s in some]
            for key, title in event_rows(same):
                if key not in ("label", "t"):
                    table.add_row("  " + escape(title), *[cell(e.get(key)) for e in same])
        return table

    console = terminal()
    for table in fitting(console, list(summaries), table_of):
        console.print(table)
