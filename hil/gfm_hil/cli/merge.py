"""gfmhil merge: one run folder from those of a plant and its controllers, started separately."""

import argparse
from pathlib import Path

from gfm_hil.api.runs import merge
from gfm_hil.cli import common
from gfm_hil.results.report import PAGE


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Merge the folders that gfmhil controller and gfmhil plant recorded of one run into one "
        "run folder with all signals, metrics, figures and the report; of a network the folder of "
        "the plant and those of all its controllers. They are kept."
    )
    command.add_argument("first", type=Path, metavar="A", help="folder of one side, or of a plant")
    command.add_argument(
        "others", type=Path, nargs="+", metavar="B",
        help="folder of the other side, or of each controller",
    )  # fmt: skip
    command.add_argument("-o", "--out", help="run folder; runs/merged-<time> by default")
    common.add_open(command)


def call(options: argparse.Namespace) -> int:
    folder = common.new_folder(options.out, "merged")
    run = merge(options.first, options.others, folder)
    common.print_parts(common.run_in_words(run, folder))
    common.show_page(options, folder / PAGE)
    return common.exit_code(run)
