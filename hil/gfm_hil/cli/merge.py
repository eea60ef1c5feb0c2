"""gfmhil merge: one run folder from the two of a controller and a plant started separately."""

import argparse
from pathlib import Path

from gfm_hil.api.runs import merge
from gfm_hil.cli.common import add_open, exit_code, new_folder, print_run, show_page
from gfm_hil.results.report import PAGE


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Merge the folders that gfmhil controller and gfmhil plant recorded of one run into one "
        "run folder with all signals, metrics, figures and the report. The two are kept."
    )
    command.add_argument("first", type=Path, metavar="A", help="folder of one side")
    command.add_argument("second", type=Path, metavar="B", help="folder of the other side")
    command.add_argument("-o", "--out", help="run folder; runs/merged-<time> by default")
    add_open(command)


def call(options: argparse.Namespace) -> int:
    folder = new_folder(options.out, "merged")
    run = merge(options.first, options.second, folder)
    print_run(run, folder)
    show_page(options, folder / PAGE)
    return exit_code(run)
