"""A campaign: checked, and run in chunks on the cores of this machine or on a Dask cluster; its
records on disk: JSON, one run a line, so that nothing done is ever lost."""

import contextlib
import json
import math
import os
import time
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import check_empty
from gfm_hil.results.report import write_report
from gfm_hil.run.runner import run_network, run_scenario
from gfm_hil.studies.campaign.loading import Tell, load_campaign
from gfm_hil.studies.campaign.result import CampaignResult, find_axes, verdict
from gfm_hil.studies.campaign.spec import Campaign
from gfm_hil.studies.campaign.worker import (
    Job,
    Record,
    compile_once,
    no_steady_state,
    of_network,
    record,
    run_chunk,
)
from gfm_hil.studies.workers import SILENT, Pool, Watch, WorkerLost, pool_of, run_tasks

#: runs a task, at most: about a second, so that little is lost and little is waited for; fewer
#: leave lanes empty for longer, at the end of each task
CHUNK = 128
_FILE = "runs.jsonl"
_PATIENCE_S = 1.0  # how long the checks may go on without a word


class Store:
    """``runs.jsonl`` of a campaign's folder: a line about the campaign, then its records; with
    ``resume`` it goes on with what is there, without a folder it keeps them in memory only. Raises
    UserError: the folder is in use, or holds the records of another campaign."""

    def __init__(self, folder: Path | None, campaign: Campaign, resume: bool) -> None:
        self._path = None if folder is None else folder / _FILE
        self.records: dict[Job, Record] = {}
        if folder is None or self._path is None:
            return
        if self._path.is_file() and resume:
            self._read(self._path, campaign)
            return
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            more = ", or go on with it: resume" if self._path.is_file() else ""
            raise UserError(f"{folder}: is in use; choose another folder{more}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "campaign.toml").write_text(campaign.text, encoding="utf-8")
            self._write([{"digest": campaign.digest(), "version": version("gfmhil")}])
        except OSError as problem:
            raise UserError(f"{folder}: {problem.strerror}; choose another --out") from None

    def _read(self, path: Path, campaign: Campaign) -> None:
        whole = path.read_bytes()
        kept = whole[: whole.rfind(b"\n") + 1]  # the last line may have been cut off
        try:
            head, *records = [json.loads(line) for line in kept.splitlines()]
            made_by, digest = head["version"], head["digest"]
            self.records = {(r["run"], r["law"]): r for r in records}
        except (ValueError, KeyError, TypeError) as problem:
            raise UserError(f"{path}: cannot be read: {problem!r}") from None
        if made_by != version("gfmhil"):
            raise UserError(
                f"{path}: made by gfmhil {made_by}, this is {version('gfmhil')}; "
                "choose another --out"
            )
        if digest != campaign.digest():
            raise UserError(
                f"{path}: belongs to another campaign: the file, its scenario or a law has "
                f"changed since (see campaign.toml there); choose another --out"
            )
        if len(kept) < len(whole):
            with path.open("r+b") as file:
                file.truncate(len(kept))

    def append(self, records: list[Record]) -> None:
        """Keep some records; a store with a folder has them on the disk when this returns."""
        self._write(records)
        self.records.update({(r["run"], r["law"]): r for r in records})

    def _write(self, lines: list[Record]) -> None:
        if self._path is None:
            return
        with self._path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(line) + "\n" for line in lines))
            file.flush()
            os.fsync(file.fileno())

    def missing(self, campaign: Campaign) -> list[Job]:
        """What is still to be run, in order of the run numbers."""
        jobs = [(run, law) for run in range(campaign.file.runs) for law in campaign.file.laws]
        return [job for job in jobs if job not in self.records]

    def sorted(self, campaign: Campaign) -> list[Record]:
        """The records of the campaign's runs, by run number and law."""
        laws, runs = campaign.file.laws, campaign.file.runs
        wanted = [r for r in self.records.values() if r["run"] < runs and r["law"] in laws]
        return sorted(wanted, key=lambda r: (r["run"], laws.index(r["law"])))


def run_campaign(
    given: str | Path | dict[str, Any],
    folder: Path | None,
    *,
    laws: Mapping[str, str],
    changes: Mapping[str, Any],
    workers: int | str,
    resume: bool,
    x: str | None,
    y: str | None,
    watch: Watch = SILENT,
) -> CampaignResult:
    """As ``gfmhil.campaign``, with law files by name. Raises UserError: one line a mistake; the
    folder is in use. Raises WorkerLost: workers died of the same runs, or one raised an error; its
    ``result`` has all others."""
    if resume and folder is None:
        raise UserError("resume: goes with the folder to go on with (--out)")
    began, lost, store = time.monotonic(), None, None
    try:
        with contextlib.ExitStack() as stack:
            # workers import while the runs are checked
            pool = stack.enter_context(pool_of(workers))
            campaign = load_campaign(given, laws, changes, checks_progress(watch))
            axes = find_axes(campaign, x, y)
            pool.check_equal(campaign.digest)  # before anything is written
            store = Store(folder, campaign, resume)
            if jobs := store.missing(campaign):
                if pool.is_local:
                    compile_once(campaign, watch.notice)
                _execute(campaign, jobs, pool, store, watch)
    except WorkerLost as problem:
        lost = problem
    except KeyboardInterrupt:  # of a second signal: the runs under way are lost
        if store is None or not watch.stopped():
            raise
    assert store is not None
    wall_s = time.monotonic() - began
    found = CampaignResult(campaign, store.sorted(campaign), folder, workers, wall_s, axes)
    if folder is not None:
        found.write(folder)
    if lost is not None:
        lost.result = found
        raise lost
    return found


def checks_progress(watch: Watch) -> Tell:
    """What tells a watch of the checks of a campaign, in a line once they take long."""
    began, told = time.monotonic(), False

    def tell(done: int, of: int) -> None:
        nonlocal told
        if watch.stopped():
            raise KeyboardInterrupt
        watch.progress(done, of, "checking the runs")
        if not told and time.monotonic() - began >= _PATIENCE_S:
            told = True
            watch.notice(f"checking the runs: {done} of {of} done …")

    return tell


def _execute(
    campaign: Campaign, jobs: Sequence[Job], pool: Pool, store: Store, watch: Watch
) -> None:
    """Run all jobs, or until the watch stops them; arguments and errors as for ``run_tasks``."""
    of = campaign.file.runs * len(campaign.file.laws)
    verdicts = [verdict(one) for one in store.sorted(campaign)]

    def keep(records: list[Record]) -> None:
        store.append(records)
        verdicts.extend(map(verdict, records))
        counts = {v: verdicts.count(v) for v in dict.fromkeys(verdicts)}
        told = ", ".join(f"{n} {v.replace('-', ' ')}" for v, n in counts.items())
        watch.progress(len(verdicts), of, told)

    rounds = math.ceil(len(jobs) / (CHUNK * pool.workers))
    size = math.ceil(len(jobs) / (rounds * pool.workers))
    chunks = (jobs[k : k + size] for k in range(0, len(jobs), size))
    run_tasks(partial(run_chunk, campaign), chunks, pool, keep, watch)


def run_alone(campaign: Campaign, run: int, law: str, folder: Path) -> Record:
    """Write the run folder of one run, and its record beside as ``record.json``; of a run without a
    steady state the record alone. Raises UserError: the folder is in use."""
    scenario, drawn = campaign.scenario(run, law)
    scenario = scenario.model_copy(update={"title": f"{campaign.file.title}: run {run}"})
    check_empty(folder)
    try:
        if scenario.parts:
            network = run_network(scenario, folder, report=write_report)
            summary, ticks = of_network(network, campaign.file.converter)
        else:
            whole = run_scenario(scenario, folder, report=write_report)
            summary, ticks = whole.summary, len(whole.signals["true_p"])
    except UserError as problem:
        summary, ticks = no_steady_state(problem), 0
    kept = record(run, law, scenario, drawn, summary, ticks)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "record.json").write_text(json.dumps(kept, indent=2) + "\n", "utf-8")
    return kept
