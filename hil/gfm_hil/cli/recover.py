"""gfmhil recover: complete the folder of a run that was cut off."""

import argparse
from pathlib import Path

from gfm_hil.api.runs import recover
from gfm_hil.cli.common import add_open, print_result, run_in_words, show_page
from gfm_hil.results.report import PAGE


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Complete the folder of a run that a kill, a power failure or a full disk cut off: "
        "signals, times, events, summary, figures and report of all that was recorded. "
        "The command leaves a folder that is complete as it is."
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("--json", action="store_true", help="print summary.json and nothing else")
    add_open(command)


def call(options: argparse.Namespace) -> int:
    run = recover(options.folder)
    print_result(options, run.summary, run_in_words(run, options.folder))
    show_page(options, options.folder / PAGE)
    return 0
