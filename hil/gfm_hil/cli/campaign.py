"""gfmhil campaign: one scenario many times with drawn parameters, on all cores or a cluster."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from typing import Any

from rich.progress import BarColumn, TaskProgressColumn, TimeRemainingColumn

from gfm_hil.cli.common import EXIT_INTERRUPTED, EXIT_OTHERWISE, above, new_folder, progress
from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt
from gfm_hil.realtime.priority import processors
from gfm_hil.run.runner import Notice
from gfm_hil.studies.campaign.axes import find_axes
from gfm_hil.studies.campaign.execute import WorkerLost, cluster, execute, processes, run_alone
from gfm_hil.studies.campaign.loading import load_campaign
from gfm_hil.studies.campaign.result import VERDICTS, CampaignResult, verdict, write_result
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.store import Store
from gfm_hil.studies.campaign.tables import print_campaign, print_record
from gfm_hil.studies.campaign.worker import Record, compile_once

_PATIENCE_S = 1.0  # how long the checks may go on without a word


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("file", help="campaign file, or the name of a shipped one")
    command.add_argument("-o", "--out", help="folder; runs/<campaign>-<time> by default")
    command.add_argument("--resume", action="store_true", help="run only what is missing in --out")
    command.add_argument("--workers", type=int, metavar="N", help="processes; all cores by default")
    command.add_argument("--dask", metavar="ADDRESS", help="run on a cluster, e.g. tcp://host:8786")
    command.add_argument("--x", metavar="PATH", help="drawn path of the figure, or a sum a+b")
    command.add_argument("--y", metavar="PATH", help="the same; the first two drawn by default")
    command.add_argument("--only", type=int, metavar="RUN", help="one run, with its run folder")
    command.add_argument("--json", action="store_true", help="print campaign.json, nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    """Carry the command out; 0 if every run ran, whatever became of it."""
    if options.workers is not None and not 1 <= options.workers <= 1024:
        raise UserError(f"--workers {options.workers}: must lie in [1, 1024]")
    if options.workers is not None and options.dask:
        raise UserError("--workers, --dask: the cluster knows its workers; give one of them")
    if options.resume and (not options.out or options.only is not None):
        raise UserError("--resume: goes with --out, the folder to go on with, and without --only")
    with contextlib.ExitStack() as stack:
        executor: Executor | None = None
        workers = options.workers or processors()
        own = options.only is None and not options.dask
        with _checking(options.quiet) as tell_checks:

            def check(done: int, of: int) -> None:
                nonlocal executor
                if own and executor is None:  # the file is good: imports go on meanwhile
                    executor = stack.enter_context(processes(workers))
                tell_checks(done, of)

            campaign = load_campaign(options.file, check)
        axes = find_axes(campaign, options.x, options.y)
        if options.only is not None:
            return _only(options, campaign)
        store_at = new_folder(options.out, campaign.name)
        if options.dask:  # before anything is written
            executor, workers = stack.enter_context(cluster(options.dask, campaign))
        store = Store(store_at, campaign, options.resume)
        jobs = store.missing(campaign)
        began, lost = time.monotonic(), None
        with Interrupt() as interrupt, _bar(campaign, store, options.quiet) as (tell, notice):
            if jobs and own:
                compile_once(campaign, notice)

            def keep(records: list[Record]) -> None:
                store.append(records)
                tell(records)

            if jobs and executor is not None:
                try:
                    execute(campaign, jobs, executor, workers, keep, lambda: interrupt.came)
                except WorkerLost as problem:
                    lost = problem
                except KeyboardInterrupt:  # a second signal: the runs under way are lost
                    interrupt.ask()
    found = CampaignResult(campaign, store.sorted(campaign), store_at)
    result = write_result(found, store_at, axes, options.dask or workers, time.monotonic() - began)
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print_campaign(result, axes, store_at)
    if result["missing"]:
        again = f"go on with: gfmhil campaign {options.file} --out {store_at} --resume"
        why = f"{lost}; " if lost else "interrupted; "
        print(f"gfmhil: {why}{result['missing']} runs are missing; {again}", file=sys.stderr)
        return EXIT_OTHERWISE if lost else EXIT_INTERRUPTED
    return 0


def _only(options: argparse.Namespace, campaign: Campaign) -> int:
    """One run of every law, in a worker: there its arithmetic is that of the campaign."""
    if not 0 <= options.only < campaign.file.runs:
        raise UserError(f"--only {options.only}: must lie in [0, {campaign.file.runs - 1}]")
    folder = new_folder(options.out, f"{campaign.name}-{options.only}")
    records = []
    with processes(1) as pool:
        for law in campaign.file.laws:
            place = folder / law.removesuffix(".toml").replace("/", "_")
            records.append(pool.submit(run_alone, campaign, options.only, law, place).result())
            if not options.json:
                print_record(records[-1], place)
    if options.json:
        print(json.dumps(records, indent=2))
    return 0


@contextlib.contextmanager
def _checking(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A bar for the checks, which appears once they take long; one line where there is no
    terminal. Yields what tells it of them."""
    began = time.monotonic()
    with progress("{task.description}", BarColumn(), TaskProgressColumn(), quiet=quiet) as bar:
        task = bar.add_task("checking the runs", visible=False)

        def tell(done: int, of: int) -> None:
            if time.monotonic() - began < _PATIENCE_S:
                return
            if bar.disable and not bar.tasks[0].visible:
                bar.console.print(f"checking the runs: {done} of {of} done …")
            bar.update(task, completed=done, total=of, visible=True)

        yield tell


@contextlib.contextmanager
def _bar(campaign: Campaign, store: Store, quiet: bool) -> Iterator[tuple[Any, Notice]]:
    """A bar with what became of the runs, and the time left; yields what tells it of records, and
    what prints a line above it."""
    counts = dict.fromkeys(VERDICTS, 0)
    columns = BarColumn(), TaskProgressColumn(), "{task.fields[found]}", TimeRemainingColumn()
    with progress("{task.description}", *columns, quiet=quiet) as bar:
        total = campaign.file.runs * len(campaign.file.laws)
        task = bar.add_task(campaign.name, total=total, found="starting …")

        def tell(records: list[Record]) -> None:
            for record in records:
                counts[verdict(record)] += 1
            found = ", ".join(f"{n} {v.replace('-', ' ')}" for v, n in counts.items() if n)
            bar.update(task, advance=len(records), found=found)

        if store.records:
            tell(store.sorted(campaign))
        yield tell, above(bar)
