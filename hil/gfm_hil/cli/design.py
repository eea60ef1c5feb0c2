"""gfmhil design: gamma of given gains, and gains tuned for the paper's problem."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from gfm_design.gains import FreeGain, free_gains, tied
from gfm_design.hinf import Unstable
from gfm_design.paper_problem import PaperProblem
from gfm_design.performance import Channel
from gfm_design.synthesis import NotStabilised, tune
from gfm_hil.errors import UserError
from gfm_hil.report import cell
from gfm_hil.toml_out import toml_text
from gfm_runtime import law_file
from gfm_runtime.lawfile import LawFile


def add(commands: Any) -> None:
    """Add the command and its sub-commands to the parser."""
    command = commands.add_parser("design", help="gamma, and gains by H-infinity synthesis")
    kinds = command.add_subparsers(dest="design", required=True, metavar="WHAT")
    gamma = kinds.add_parser("gamma", help="gamma of a law's gains, channel by channel")
    gamma.set_defaults(call=call_gamma)
    search = kinds.add_parser("tune", help="choose the free gains for the least gamma")
    search.add_argument("--seed", type=int, default=0, help="of the search")
    search.add_argument("--evaluations", type=int, default=12000, help="how long to search")
    search.add_argument("--only", help="free gains to move, separated by commas; all by default")
    search.add_argument("--out", help="write the tuned law to this file")
    search.add_argument("--quiet", action="store_true", help="no progress on stderr")
    search.set_defaults(call=call_tune)
    for sub in (gamma, search):
        sub.add_argument("--law", required=True, help="catalogue name or law file")
        sub.add_argument("--gains", help="k=v,…: other values (tune: other starts)")
        sub.add_argument("--json", action="store_true", help="as JSON")


def read_gains(text: str | None) -> dict[str, float]:
    """``k_22=5,k_34=1`` as a dict.

    Raises:
        UserError: an entry that is not NAME=NUMBER.
    """
    found = {}
    for entry in text.split(",") if text else []:
        name, _, value = entry.partition("=")
        try:
            found[name.strip()] = float(value)
        except ValueError:
            raise UserError(f"--gains {entry!r}: must be NAME=NUMBER, e.g. k_22=5.98") from None
    return found


def call_gamma(options: argparse.Namespace) -> int:
    """Report gamma of given gains; exit code 3 for an unstable loop, which has none."""
    file, given = law_file(options.law), read_gains(options.gains)
    unknown = sorted(set(given) - set(file.parameters))
    if unknown:
        raise UserError(
            f"--gains: {unknown} unknown to {file.name}; known: {list(file.parameters)}"
        )
    # every parameter may be given here; they are the "free" ones, pinned at these values
    values = tied(file, given) if given else {}
    gains = [FreeGain(n, v, -np.inf, np.inf) for n, v in values.items()]
    problem = PaperProblem(file, tuple(gains))
    try:
        channels = problem.channels(np.array([g.start for g in gains]))
    except Unstable as problem_found:
        if options.json:
            print(json.dumps({"law": file.name, "gamma": None, "reason": str(problem_found)}))
        else:
            Console().print(f"{file.name}: no gamma, {problem_found}", highlight=False)
        return 3
    if options.json:
        print(json.dumps({"law": file.name, **_as_json(channels)}, indent=2))
    else:
        _print(file.name, channels)
    return 0


def call_tune(options: argparse.Namespace) -> int:
    """Tune a law's free gains; exit code 3 if no stabilising ones are found."""
    file = law_file(options.law)
    only = options.only.split(",") if options.only else None
    gains = free_gains(file, read_gains(options.gains), only)
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
        **_as_json(channels),
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
        _print(file.name, channels)
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


def _as_json(channels: Sequence[Channel]) -> dict[str, Any]:
    rows = [{"i": c.i, "j": c.j, "norm": c.norm, "omega_rad_s": c.omega} for c in channels]
    return {"gamma": max(c.norm for c in channels), "channels": rows}


def _print(name: str, channels: Sequence[Channel]) -> None:
    table = Table("channel", "‖W T‖∞", "at \\[rad/s]", box=None, pad_edge=False, title=None)
    for c in channels:
        table.add_row(f"W_{c.i}{c.j} T_{c.i}{c.j}", f"{c.norm:.6g}", cell(c.omega))
    console = Console(highlight=False)
    console.print(f"[bold]{name}[/]: γ = {max(c.norm for c in channels):.6g}")
    console.print(table)
