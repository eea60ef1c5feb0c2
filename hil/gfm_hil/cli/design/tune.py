"""gfmhil design tune: the free gains of a law for the least gamma, as a law file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn

from gfm_design.tuning.full_order import Missing, full_order
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.law_comparison_modes import culprit
from gfm_design.tuning.paper_problem import PAPER_START, PaperProblem
from gfm_design.tuning.paper_tune import EVALUATIONS, starts_for, tune_paper
from gfm_design.tuning.synthesis import NotStabilised, Tuned
from gfm_hil.cli.common import EXIT_OTHERWISE
from gfm_hil.cli.design.common import (
    add_law_options,
    channels_as_json,
    print_channels,
    read_gains,
    singular_is_users,
    weights_of,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.studies.tuned_law import write_law
from gfm_runtime import law_file


def add(kinds: Any) -> None:
    """Add the command to the parser."""
    command = kinds.add_parser("tune", help="choose the free gains for the least gamma")
    add_law_options(command)
    command.add_argument("--seed", type=int, default=0, help="of the search")
    command.add_argument(
        "--evaluations", type=int, default=EVALUATIONS, help="of each start, before its polish"
    )
    command.add_argument(
        "--starts",
        type=int,
        help="the given start and random ones; 6, and one more a gain, if left out",
    )
    command.add_argument("--only", help="free gains to move, separated by commas; all by default")
    command.add_argument("--full-order", action="store_true", help="a bound from below besides")
    command.add_argument("--out", help="write the tuned law to this file")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.set_defaults(call=call)


@singular_is_users
def call(options: argparse.Namespace) -> int:
    """Tune a law's free gains; exit code 3 if no stabilising ones are found."""
    for name in ("evaluations", "starts"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise UserError(f"--{name} {getattr(options, name)}: must be at least 1")
    if options.seed < 0:
        raise UserError(f"--seed {options.seed}: must not be negative")
    if options.out and not Path(options.out).parent.is_dir():
        raise UserError(f"--out {options.out}: {Path(options.out).parent} is no folder")
    file = law_file(options.law)
    only = None if options.only is None else options.only.split(",")
    paper = PAPER_START.get(file.name, {})
    gains = free_gains(
        file,
        {n: v for n, v in paper.items() if only is None or n in only} | read_gains(options.gains),
        only,
    )
    problem = PaperProblem(file, gains, weights=weights_of(options))
    try:
        found = _searched(problem, options)
    except NotStabilised as none:
        reason = (
            f"{none}; in the way, on the paper's converter at P_ref = {problem.references[1]:g}: "
            f"{culprit(problem.closed_loop(none.values)).words()}"
        )
        if options.json:
            print(json.dumps({"law": file.name, "gamma": None, "reason": reason}))
        else:
            terminal(stderr=True).print(f"{file.name}: {reason}", highlight=False, soft_wrap=True)
        return EXIT_OTHERWISE
    except ModuleNotFoundError as missing:
        raise UserError(str(missing)) from None
    named, channels = problem.law.named(found.values), problem.channels(found.values)
    result = {
        "law": file.name,
        **channels_as_json(channels),
        "gamma_full_order": None,
        "gains": named,
        "seconds": found.seconds,
        "evaluations": found.evaluations,
        "seed": found.seed,
    }
    said = _bound(problem, result) if options.full_order else ""
    if options.out:
        write_law(Path(options.out), file, named, result)
    if options.json:
        print(json.dumps(result, indent=2))
        return 0
    print_channels(file.name, channels)
    lines = [
        ", ".join(f"{n} = {v:.6g}" for n, v in named.items()),
        f"{found.evaluations} evaluations in {found.seconds:.1f} s, seed {found.seed}"
        + (f"; law file: {options.out}" if options.out else ""),
        said,
    ]
    terminal(highlight=False, soft_wrap=True).print("\n".join(line for line in lines if line))
    return 0


def _searched(problem: PaperProblem, options: argparse.Namespace) -> Tuned:
    """The search, with a bar on stderr."""
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("γ {task.fields[best]}"),
        console=terminal(stderr=True, quiet=options.quiet),
        transient=True,
    ) as bar:
        starts = options.starts or starts_for(len(problem.gains))
        total = options.evaluations * starts
        task = bar.add_task(f"tuning {problem.file.name}", total=total, best="–")
        return tune_paper(
            problem,
            options.seed,
            options.evaluations,
            starts,
            lambda done, best: bar.update(task, completed=done, best=f"{best:.4g}"),
        )


def _bound(problem: PaperProblem, result: dict[str, Any]) -> str:
    """The full-order bound into the result; what to say of it."""
    try:
        found = full_order(problem.linear, problem.weights)
    except Missing as missing:
        terminal(stderr=True).print(str(missing), highlight=False, soft_wrap=True)
        return ""
    if found is None:
        return "full order: the solver came to no result in time"
    result["gamma_full_order"] = found.bound
    result["full_order_columns"] = list(found.columns)
    columns = ", ".join("not solved" if c is None else f"{c:.4g}" for c in found.columns)
    return f"no controller at all goes below {found.bound:.4g}; stack of P_ref, of ω_g: {columns}"
