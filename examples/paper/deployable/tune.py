"""Gains that hold in the box of real loops, as a law file."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deployable.box import Box, Point, Source
from deployable.check import add_box, margin_text, read_box, wanted
from deployable.robust import Wanted, paper_problem
from deployable.search import Round, deploy
from gfm_design.margins.delays import overall_delay
from gfm_design.model.closed_loop import T_S
from gfm_design.tuning.gains import free_gains
from gfm_design.tuning.synthesis import NotStabilised
from gfm_hil.api.design import channels_as_json, law_text, problem_name
from gfm_hil.cli.common import print_result
from gfm_hil.cli.design.gains import (
    add_law_options,
    channels_in_words,
    chosen_law,
    problem_title,
    read_gains,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_runtime import build_law, discretise, parse_law
from gfm_runtime.lawfile import LawFile, tied


def add(kinds: Any) -> None:
    command = kinds.add_parser("tune", help="choose the free gains to hold in the box")
    add_law_options(command)
    add_box(command)
    command.add_argument("--want", help="k=v,…: other demands, e.g. alpha=1.5,strong=0.04")
    command.add_argument("--only", help="free gains to move, separated by commas; all by default")
    command.add_argument("--seed", type=int, default=0, help="of the search")
    command.add_argument("--rounds", type=int, default=6, help="how often corners may join")
    command.add_argument("--evaluations", type=int, default=2500, help="of each round")
    command.add_argument("-o", "--out", required=True, help="write the law to this file")
    command.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Tune a law for the box; exit code 3 if no stabilising gains are found."""
    file = chosen_law(options)
    only = options.only.split(",") if options.only else None
    gains = free_gains(file, read_gains(options.gains), only)
    box = read_box(options.box)
    demands = wanted(read_gains(options.want, "--want"), box)
    console = terminal(stderr=True, highlight=False)

    def tell(found: Round) -> None:
        console.print(
            f"{found.seconds:.0f} s: γ {found.gamma:.4f}, sigma {found.sigma:+.3f} 1/s, "
            f"overshoot {100 * found.overshoot:.1f} %, over {found.points} corners"
        )

    try:
        found = deploy(
            file, gains, box, demands, options.seed, options.rounds, options.evaluations, tell=tell
        )
    except NotStabilised as none:
        console.print(f"{file.name}: {none}")
        return 3
    except ModuleNotFoundError as missing:
        raise UserError(str(missing)) from None
    source: Source = "controlled" if "controlled" in box.dc else "regulated"
    channels = paper_problem(file, gains, source).channels(found.values)
    # seven digits: what the search resolves, and what a reader can compare
    values = [float(f"{v:.7g}") for v in found.values]
    named = tied(file, dict(zip([g.name for g in gains], values, strict=True)))
    result = channels_as_json(channels) | {"seed": options.seed, "seconds": found.seconds}
    _write(Path(options.out), file, named, result | {"source": source}, box, demands)
    renamed = file.model_copy(update={"name": Path(options.out).stem})
    print_result(options, result, channels_in_words(problem_title(renamed), channels))
    return 0


def _demands(demands: Wanted) -> dict[str, float]:
    """The demands in force: with a single source none is relaxed."""
    both = demands.rig_alpha is not None
    return {k: v for k, v in asdict(demands).items() if both or not k.startswith("rig_")}


def _source(box: Box) -> str:
    return "" if len(set(box.dc)) > 1 else f", DC source {box.dc[0]}"


def _write(
    path: Path,
    file: LawFile,
    gains: dict[str, float],
    result: dict[str, Any],
    box: Box,
    demands: Wanted,
) -> None:
    """The law file and, as comments, what its gains were tuned for."""
    comments = [
        f"gamma = {result['gamma']:.4f} of {problem_name(file)}, P_ref = 0.5, "
        f"DC source {result['source']}:",
        "  " + ", ".join(f"W_{c['i']}{c['j']} {c['norm']:.4f}" for c in result["channels"]),
        f"seed {result['seed']}, {result['seconds']:.0f} s, started from {file.name}",
        "asked: " + ", ".join(f"{k} {v:g}" for k, v in _demands(demands).items()),
        "the box, sensors of 300 Hz, T_s = 100 us, delay in samples:",
        *(f"  {name} {' '.join(map(str, values))}" for name, values in asdict(box).items()),
    ]
    text = law_text(
        file,
        gains,
        f"python -m deployable tune, seed {result['seed']}",
        comments,
        name=path.stem,
        title=f"the paper's MIMO-GFM, gains that hold in the real loop{_source(box)}",
        source="Eq. (36); gains by python -m deployable tune, see the comments of the file\n",
    )
    law = discretise(build_law(parse_law(text)), T_S)
    margins = ", ".join(
        f"{margin_text(overall_delay(Point(dc=dc).loop(law)).seconds)} (DC source {dc})"
        for dc in dict.fromkeys(box.dc)
    )
    path.write_text(f"# delay margin at nominal {margins}\n{text}", "utf-8")
