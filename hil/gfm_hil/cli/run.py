"""gfmhil run: one scenario, one run folder."""

from __future__ import annotations

import argparse
import json
from typing import Any

from gfm_hil.cli.common import (
    add_scenario_options,
    exit_code,
    new_folder,
    print_summary,
    progress_bar,
    resolve,
)
from gfm_hil.runner import run_scenario
from gfm_hil.scenario import find_scenario


def add(commands: Any) -> None:
    """Add the command to the parser."""
    command = commands.add_parser("run", help="run a scenario and leave a run folder")
    add_scenario_options(command)
    command.add_argument("--law", help="override law: catalogue name or law file")
    command.add_argument("--out", help="run folder; runs/<scenario>-<time> by default")
    command.add_argument("--json", action="store_true", help="print summary.json and nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.add_argument("--no-figures", action="store_true", help="neither figures nor report")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Carry the command out; returns the exit code."""
    scenario = resolve(options, law=options.law)
    folder = new_folder(options.out, find_scenario(options.scenario).stem)
    with progress_bar(scenario, scenario.title, options.quiet) as (progress, notice):
        run = run_scenario(scenario, folder, progress, notice, figures=not options.no_figures)
    if options.json:
        print(json.dumps(run.summary, indent=2))
    else:
        print_summary(run.summary, folder)
    return exit_code(run.summary)
