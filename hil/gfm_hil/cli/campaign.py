"""gfmhil campaign: one scenario many times with drawn parameters, on all cores or a cluster."""

import argparse
import json
import sys
from pathlib import Path

from gfm_hil.api.studies import campaign
from gfm_hil.cli import common
from gfm_hil.core.errors import UserError
from gfm_hil.realtime.priority import processors
from gfm_hil.results.report import PAGE
from gfm_hil.studies.campaign.execute import checks_progress, run_alone
from gfm_hil.studies.campaign.loading import load_campaign
from gfm_hil.studies.campaign.tables import print_campaign, print_record
from gfm_hil.studies.workers import WorkerLost, processes


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("file", help="campaign file, or the name of a shipped one")
    command.add_argument("--resume", action="store_true", help="run only what is missing in --out")
    common.add_workers(command, "all cores")
    command.add_argument("--x", metavar="PATH", help="drawn path of the figure, or a sum a+b")
    command.add_argument("--y", metavar="PATH", help="the same; the first two drawn by default")
    command.add_argument("--only", type=int, metavar="RUN", help="one run, with its run folder")
    common.add_open(command)
    common.add_study_options(command, "campaign.json", "<campaign>")


def call(options: argparse.Namespace) -> int:
    """Carry the command out; 0 if every run ran, whatever became of it."""
    if options.resume and (not options.out or options.only is not None):
        raise UserError("--resume: goes with --out, the folder to go on with, and without --only")
    if options.only is not None:
        return _only(options)
    name, lost = Path(options.file).stem, ""
    with common.watching(name, options.quiet, stoppable=True) as watch:
        try:
            found = campaign(
                options.file, common.new_folder(options.out, name),
                workers=common.workers_of(options, processors()), resume=options.resume,
                x=options.x, y=options.y, watch=watch,
            )  # fmt: skip
        except WorkerLost as problem:
            found, lost = problem.result, str(problem)
    if options.json:
        print(json.dumps(found.plain(), indent=2))
    else:
        print_campaign(found)
    if found.folder is not None:
        common.show_page(options, found.folder / PAGE)
    if missing := found.summary["missing"]:
        again = f"go on with: gfmhil campaign {options.file} --out {found.folder} --resume"
        why = lost or "interrupted"
        print(f"gfmhil: {why}; {missing} runs are missing; {again}", file=sys.stderr)
        return common.EXIT_OTHERWISE if lost else common.EXIT_INTERRUPTED
    return 0


def _only(options: argparse.Namespace) -> int:
    """One run of every law, in a worker: there its arithmetic is that of the campaign."""
    with common.watching(Path(options.file).stem, options.quiet) as watch:
        made = load_campaign(options.file, tell=checks_progress(watch))
    if not 0 <= options.only < made.file.runs:
        raise UserError(f"--only {options.only}: must lie in [0, {made.file.runs - 1}]")
    folder = common.new_folder(options.out, f"{made.name}-{options.only}")
    records = []
    with processes(1) as pool:
        for law in made.file.laws:
            place = folder / law.removesuffix(".toml").replace("/", "_")
            records.append(pool.submit(run_alone, made, options.only, law, place).result())
            if not options.json:
                print_record(records[-1], place)
    if options.json:
        print(json.dumps(records, indent=2))
    return 0
