"""gfmhil design tune: the free gains of a law for the least gamma, as a law file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from gfm_design.gains import free_gains
from gfm_design.paper_problem import PAPER_START, PaperProblem
from gfm_design.synthesis import NotStabilised, tune
from gfm_hil.cli.design.common import (
    add_law_options,
    channels_as_json,
    print_channels,
    read_gains,
)
from gfm_hil.errors import UserError
from gfm_hil.toml_out import toml_text
from gfm_runtime import law_file
from gfm_runtime.lawfile import LawFile


def add(kinds: Any) -> None:
    """Add the command to the parser."""
    command = kinds.add_parser("tune", help="choose the free gains for the least gamma")
    add_law_options(command)
    command.add_argument("--seed", type=int, default=0, help="of the search")
    command.add_argument("--evaluations", type=int, default=16000, help="of each start")
    command.add_argument("--starts", type=int, default=1, help="the given start and random ones")
    command.add_argument("--only", help="free gains to move, separated by commas; all by default")
    command.add_argument("--out", help="write the tuned law to this file")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Tune a law's free gains; exit code 3 if no stabilising ones are found."""
    file = law_file(options.law)
    only = options.only.split(",") if options.only else None
    start = PAPER_START.get(file.name, {}) | read_gains(options.gains)
    gains = free_gains(file, start, only)
    problem = PaperProblem(file, gains)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("γ {task.fields[best]}"),
        console=Console(stderr=True, quiet=options.quiet),
        transient=True,
    ) as bar:
        task = bar.add_task(f"tuning {file.name}", total=options.evaluations, best="–")
        try:
            found = tune(
                problem,
                gains,
                options.seed,
                options.evaluations,
                options.starts,
                lambda done, best: bar.update(task, completed=done, best=f"{best:.4g}"),
            )
        except NotStabilised as none:
            Console(stderr=True).print(f"{file.name}: {none}", highlight=False)
            return 3
        except ModuleNotFoundError as missing:
            raise UserError(str(missing)) from None
    named = problem.law.named(found.values)
    problem.move_to(named)
    channels = problem.channels(found.values)
    result = {
        "law": file.name,
        **channels_as_json(channels),
        "gains": named,
        "seconds": found.seconds,
        "evaluations": found.evaluations,
        "seed": found.seed,
    }
    if options.out:
        write_law(Path(options.out), file, named, result)
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print_channels(file.name, channels)
        Console().print(
            ", ".join(f"{n} = {v:.6g}" for n, v in named.items()), highlight=False, soft_wrap=True
        )
        Console().print(
            f"{found.evaluations} evaluations in {found.seconds:.1f} s, seed {found.seed}"
            + (f"; law file: {options.out}" if options.out else ""),
            highlight=False,
        )
    return 0


def write_law(path: Path, file: LawFile, gains: dict[str, float], result: dict[str, Any]) -> None:
    """The law file with its tuned gains and, as comments, what they were tuned for.

    Raises:
        UserError: the file cannot be written.
    """
    content = file.model_dump(mode="json", exclude_none=True)
    content["name"] = path.stem
    content["title"] = f"{file.title}, tuned"
    content["source"] = f"{file.source.strip()}; tuned by gfmhil design tune, see the comments"
    for name, value in gains.items():
        content["parameters"][name]["value"] = value
        content["parameters"][name]["source"] = f"gfmhil design tune, seed {result['seed']}"
    notes = [
        f"# gamma = {result['gamma']:.6g} of the paper's problem (Section III-B), P_ref = 0.5",
        *(f"# W_{c['i']}{c['j']}: {c['norm']:.6g}" for c in result["channels"]),
        f"# {result['evaluations']} evaluations, {result['seconds']:.1f} s, seed {result['seed']}",
    ]
    try:
        path.write_text("\n".join(notes) + "\n\n" + toml_text(content), encoding="utf-8")
    except OSError as problem:
        raise UserError(f"--out {path}: {problem.strerror}") from None
