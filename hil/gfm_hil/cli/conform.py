"""gfmhil conform: published tests of grid-forming converters, judged clause by clause."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, TaskProgressColumn, TimeRemainingColumn
from rich.table import Table

from gfm_hil.cli.common import (
    EXIT_INTERRUPTED,
    EXIT_OTHERWISE,
    above,
    add_map,
    new_folder,
    progress,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.core.stopping import Interrupt
from gfm_hil.core.terminal import fitting, terminal
from gfm_hil.realtime.priority import processors
from gfm_hil.studies.campaign.execute import WorkerLost
from gfm_hil.studies.conformity.diff import SHARE, compare_results, read_results
from gfm_hil.studies.conformity.execute import Found, execute, foreign_controller, make_jobs
from gfm_hil.studies.conformity.judge import CANNOT, FAIL, INFORMATIVE, PASS, SIGNS
from gfm_hil.studies.conformity.result import Conformity
from gfm_hil.studies.conformity.sets import ALL, Case, load_cases, load_under_test, shipped_sets
from gfm_runtime import law_file, law_names, law_titles
from gfm_runtime.inner_file import named_inner

EXIT_FAILED = 1
_EXIT = {PASS: 0, FAIL: EXIT_FAILED, CANNOT: 4, INFORMATIVE: 4}
_COLOURS = {PASS: "green", FAIL: "red", CANNOT: "yellow", INFORMATIVE: "blue"}


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Exit code 0: every clause passes, the informative ones left out; 1: one fails; 2: wrong "
        "input; 4: none fails, but one cannot be judged."
    )
    others = command.add_subparsers(metavar="{diff}", title="on reports")
    diff = others.add_parser("diff", help="what changed between two reports")
    diff.description = (
        "Exit code 0: nothing got worse; 1: a verdict did, or a clause that passed is gone; 2: "
        "wrong input."
    )
    diff.set_defaults(call=_diff)
    diff.add_argument(
        "old", type=Path, metavar="OLD", help="folder of a report, or its results.json"
    )
    diff.add_argument("new", type=Path, metavar="NEW", help="the same")
    diff.add_argument(
        "--share", type=float, default=SHARE, metavar="X",
        help=f"values that moved by more than this part of the larger are told; {SHARE:g}",
    )  # fmt: skip
    diff.add_argument("--html", type=Path, metavar="FILE", help="write a page too")
    diff.add_argument("--json", action="store_true", help="print all of it as JSON, nothing else")
    command.add_argument(
        "--law", action="append", metavar="LAW",
        help="catalogue name or law file; may be repeated; all: the whole catalogue",
    )  # fmt: skip
    command.add_argument(
        "--controller", metavar="KIND:FILE",
        help="dll:FILE (IEEE/CIGRE), fmu:FILE or c:FILE: a controller to test, with or without "
        "laws beside it; it begins at the operating point of the first law; or pil:TARGET, the "
        "first law as firmware on a processor in QEMU",
    )  # fmt: skip
    add_map(command, "--controller")
    command.add_argument(
        "--inner", metavar="NAME",
        help="inner stage of every law: a shipped name (gfmhil laws), a file, or none",
    )  # fmt: skip
    command.add_argument(
        "--against", action="append", metavar="SET",
        help=f"{', '.join(shipped_sets())}, or a path of your own; may be repeated; all: the "
        "shipped ones (default)",
    )  # fmt: skip
    command.add_argument(
        "--converter", metavar="FILE", help="the converter under test; the shipped one by default"
    )
    command.add_argument(
        "-o", "--out", metavar="DIR", help="folder; runs/conform-<time> by default"
    )
    command.add_argument("--workers", type=int, metavar="N", help="processes; all cores by default")
    command.add_argument("--no-figures", action="store_true", help="no figure of each run")
    command.add_argument("--list", action="store_true", help="list the tests, and run nothing")
    command.add_argument("--json", action="store_true", help="print results.json, nothing else")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    """Carry the command out; returns the exit code."""
    cases = load_cases(options.against or [ALL])
    if options.list:
        if options.json:
            print(json.dumps([_plain(case) for case in cases], indent=2))
        else:
            terminal().print(_list(cases))
        return 0
    if not options.law and options.controller is None:
        raise UserError("--law: missing; name a law, or all, or a --controller")
    if options.workers is not None and not 1 <= options.workers <= 1024:
        raise UserError(f"--workers {options.workers}: must lie in [1, 1024]")
    foreign = foreign_controller(options.controller, options.map)
    given = [n for law in options.law or [] for n in _names(law)]
    for name in given:
        law_file(name)
    titles = law_titles(given)
    laws = [*titles.values()]
    if options.inner is not None:
        named_inner(options.inner)
    under = load_under_test(options.converter)
    folder = new_folder(options.out, "conform")
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"{folder}: is not empty; choose another --out")
    files = {
        title: str(Path(name).absolute()) if name.endswith(".toml") else name
        for name, title in titles.items()
    }
    jobs = make_jobs(
        files, cases, options.inner, under, folder / "converters", folder, not options.no_figures,
        foreign,
    )  # fmt: skip
    found: list[Found] = []
    lost = None
    workers = options.workers or processors()
    columns = BarColumn(), TaskProgressColumn(), "{task.fields[at]}", TimeRemainingColumn()
    began = time.monotonic()
    with Interrupt() as interrupt, progress("{task.description}", *columns,
                                            quiet=options.quiet) as bar:  # fmt: skip
        task = bar.add_task("conform", total=len(jobs), at="starting …")

        def keep(one: Found) -> None:
            found.append(one)
            bad = sum(f.verdict in (FAIL, CANNOT) for f in found)
            at = f"{one.law}: {one.test}" + (f", {bad} not passed" if bad else "")
            bar.update(task, advance=1, at=escape(at))

        try:
            execute(jobs, workers, keep, lambda: interrupt.came, above(bar))
        except WorkerLost as problem:
            lost = problem
        except KeyboardInterrupt:  # a second signal: the runs under way are lost
            interrupt.ask()
    if len(found) < len(jobs):
        why = str(lost) if lost else "interrupted"
        done = f"{len(found)} of {len(jobs)} runs were done; there is no report"
        print(f"gfmhil: {why}; {done}", file=sys.stderr)
        return EXIT_OTHERWISE if lost else EXIT_INTERRUPTED
    names = [*laws, *([foreign.name] if foreign else [])]
    result = Conformity(names, options.inner, under, cases, found, folder)
    result.write(folder)
    if options.json:
        print(json.dumps(result.plain(), indent=1))
    else:
        _print(result, time.monotonic() - began)
    return _EXIT[result.verdict]


def _diff(options: argparse.Namespace) -> int:
    """Two reports beside each other; returns the exit code."""
    found = compare_results(read_results(options.old), read_results(options.new), options.share)
    if options.html is not None:
        write_text(options.html, found.page(str(options.old), str(options.new)))
    if options.json:
        print(json.dumps(found.plain(), indent=1))
    else:
        console = terminal()
        for note in found.notes:
            console.print(escape(note), highlight=False, soft_wrap=True)
        table = Table("", "law", "test", "part", "clause", "verdict", "measured", box=None,
                      pad_edge=False)  # fmt: skip
        for row in found.rows:
            where = map(escape, (row.law, row.test, row.part, row.clause.clause))
            shown = f"[red]{row.change}[/]" if row.counts else row.change
            table.add_row(shown, *where, row.verdict, escape(row.value))
        if found.rows:
            console.print(table)
        console.print(found.words, highlight=False)
    return EXIT_FAILED if found.worse else 0


def _names(law: str) -> Sequence[str]:
    return law_names() if law == ALL else [law]


def _plain(case: Case) -> dict[str, Any]:
    runs, source = len(case.test.runs()), case.test.source.words()
    return {"test": case.id, "runs": runs, "title": case.test.title, "source": source}


def _list(cases: Sequence[Case]) -> Table:
    table = Table("test", "runs", "title", "source", box=None, pad_edge=False)
    for case in cases:
        runs = str(len(case.test.runs()))
        table.add_row(case.id, runs, case.test.title, case.test.source.words())
    return table


def _print(result: Conformity, wall_s: float) -> None:
    """The short table that ends the command."""
    console = terminal()
    if len(result.laws) == 1:
        table = Table("test", "", "why", box=None, pad_edge=False)
        for case in result.cases:
            verdict = result.matrix[result.laws[0], case.id]
            wrong = [
                f"{f.part}: {text}" if f.part else text
                for f in result.of(result.laws[0], case.id)
                if f.verdict == verdict != PASS
                for text in dict.fromkeys(v.text for v in f.wrong) or [f.reason]
            ]
            table.add_row(case.id, f"[{_COLOURS[verdict]}]{verdict}[/]", escape("\n".join(wrong)))
        console.print(table)
    else:
        for table in fitting(console, result.laws, lambda laws: _matrix(result, laws)):
            console.print(table)
    verdicts = list(result.matrix.values())
    told = ", ".join(f"{verdicts.count(v)} {v}" for v in SIGNS if v in verdicts)
    count = len(result.found)
    runs = f"{count} {'run' if count == 1 else 'runs'} in {wall_s:.1f} s"
    console.print(f"{told}; {runs}", highlight=False)
    report = Path(result.folder or ".") / "report.html"
    console.print(escape(f"report: {report}"), highlight=False, soft_wrap=True)


def _matrix(result: Conformity, laws: Sequence[str]) -> Table:
    table = Table("test", *map(escape, laws), box=None, pad_edge=False)
    for case in result.cases:
        cells = [result.matrix[law, case.id] for law in laws]
        table.add_row(case.id, *[f"[{_COLOURS[v]}]{SIGNS[v]} {v}[/]" for v in cells])
    return table
