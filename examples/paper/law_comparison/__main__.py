"""Every law tuned for the same problem, and how each then behaves.

Usage, in examples/paper:  python -m law_comparison [--jobs N] [--out FOLDER] [--publish ROOT]

``--publish`` copies what the project keeps of a whole comparison into its repository: the tables
and figures of docs/deployable.md, and the laws of runtime/gfm_runtime/laws/tuned.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn

from gfm_design.tuning.paper import EVALUATIONS
from gfm_design.tuning.synthesis import UNSTABLE
from gfm_hil.cli.common import EXIT_INTERRUPTED, EXIT_OTHERWISE, new_folder, progress, split_laws
from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt
from gfm_hil.core.terminal import terminal
from gfm_hil.studies.workers import WorkerLost
from gfm_runtime import LawError, law_names
from law_comparison.execute import kept, run
from law_comparison.figures import draw
from law_comparison.row import LEFT_OUT, Job, Row
from law_comparison.tables import TABLES, markdown, print_comparison, ranked


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the laws, as the command line says; returns the exit code."""
    command = argparse.ArgumentParser(prog="python -m law_comparison", description=__doc__)
    command.add_argument("--laws", help="names separated by commas; the whole catalogue by default")
    command.add_argument("--seed", type=int, default=0, help="of the searches")
    command.add_argument("--evaluations", type=int, default=EVALUATIONS, help="of each start")
    command.add_argument("--starts", type=int, help="of each law; more for more gains, if left")
    command.add_argument(
        "-o", "--out", help="folder to write, or to go on with; runs/law-comparison-<time>"
    )
    command.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    command.add_argument(
        "--json", action="store_true", help="print law_comparison.json, nothing else"
    )
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.add_argument("--publish", metavar="ROOT", help="repository to copy the results into")
    options = command.parse_args(arguments)
    try:
        return call(options)
    except (UserError, LawError) as problem:
        print(f"law_comparison: {problem}", file=sys.stderr)
        return 2


def call(options: argparse.Namespace) -> int:
    """Compare the laws; a law that the folder --out has already is not tuned again."""
    jobs = _jobs(options)
    folder = new_folder(options.out, "law-comparison")
    folder.mkdir(parents=True, exist_ok=True)
    rows = {job.law: row for job in jobs if (row := kept(folder, job))}
    missing = [job for job in jobs if job.law not in rows]
    lost = None
    with Interrupt() as interrupt, _bar(jobs, options) as (tell, done):
        for row in rows.values():
            done(row)

        def keep(row: Row) -> None:
            rows[row["law"]] = row
            done(row)

        if missing:
            try:
                run(missing, folder, options.jobs, tell, keep, lambda: interrupt.came)
            except WorkerLost as problem:
                lost = problem
            except KeyboardInterrupt:  # a second signal: the runs under way are lost
                interrupt.ask()
    order = ranked(list(rows.values()))
    left_out = {name: why for name, why in LEFT_OUT.items() if not options.laws}
    result = {"seed": options.seed, "laws": order, "left_out": left_out}
    (folder / "law_comparison.json").write_text(
        json.dumps(result, indent=1) + "\n", encoding="utf-8"
    )
    for name in TABLES:
        (folder / f"{name}.md").write_text(markdown(name, order), encoding="utf-8")
    draw(folder, order)
    if options.json:
        print(json.dumps(result, indent=1))
    else:
        print_comparison(order, left_out)
        terminal(highlight=False, soft_wrap=True).print(f"folder: {folder}")
    if len(rows) < len(jobs):
        why = f"{lost}; " if lost else "interrupted; "
        again = f"the same command with --out {folder} goes on"
        print(
            f"law_comparison: {why}{len(jobs) - len(rows)} laws are missing; {again}",
            file=sys.stderr,
        )
        return EXIT_OTHERWISE if lost else EXIT_INTERRUPTED
    if options.publish:
        _publish(folder, Path(options.publish))
    return 0


def _publish(folder: Path, root: Path) -> None:
    """Copy tables, figures and laws to where the project keeps them."""
    laws = root / "runtime" / "gfm_runtime" / "laws" / "tuned"
    for pattern, to in (("*.md", "docs/tables"), ("*.png", "docs/_static/figures")):
        for path in folder.glob(f"law_comparison_{pattern}"):
            shutil.copy(path, root / to / path.name)
    shutil.rmtree(laws, ignore_errors=True)
    shutil.copytree(folder / "laws", laws)


def _jobs(options: argparse.Namespace) -> list[Job]:
    for name, least in (("evaluations", 1), ("starts", 1), ("jobs", 1), ("seed", 0)):
        given = getattr(options, name)
        if given is not None and given < least:
            raise UserError(f"--{name} {given}: must be at least {least}")
    rated = [name for name in law_names() if name not in LEFT_OUT]
    names = split_laws(options.laws) if options.laws else rated
    for name in names:
        if name in LEFT_OUT:
            raise UserError(f"--laws {name}: has no row; {LEFT_OUT[name]}")
        if name not in rated:
            raise UserError(f"--laws {name}: not in the catalogue; use some of {rated}")
    return [
        Job(name, options.seed, options.evaluations, options.starts)
        for name in dict.fromkeys(names)
    ]


@contextlib.contextmanager
def _bar(jobs: list[Job], options: argparse.Namespace) -> Iterator[tuple[Any, Any]]:
    """A bar of laws and one of each search; yields what tells them of evaluations and of rows."""
    columns = BarColumn(), MofNCompleteColumn(), "{task.fields[best]}"
    with progress("{task.description}", *columns, quiet=options.quiet) as bar:
        laws = bar.add_task("laws", total=len(jobs), best="")
        searches: dict[str, Any] = {}

        def tell(law: str, done: int, best: float) -> None:
            if law not in searches:
                searches[law] = bar.add_task(law, total=None, best="")
            shown = f"γ {best:.4g}" if best < UNSTABLE else "looking for a loop that holds"
            bar.update(searches[law], completed=done, best=shown if math.isfinite(best) else "")

        def done(row: Row) -> None:
            if row["law"] in searches:
                bar.remove_task(searches.pop(row["law"]))
            bar.advance(laws)
            found = f"γ {row['gamma']:.4g}" if row["gamma"] is not None else "not stabilised"
            bar.console.print(f"{row['law']}: {found}, {row['seconds']:.0f} s")

        yield tell, done


if __name__ == "__main__":
    raise SystemExit(main())
