"""gfmhil design tune: the free gains of a law for the least gamma, as a law file."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from gfm_design.tuning.paper import EVALUATIONS
from gfm_hil.api.design import NotTuned, Tuning, tune
from gfm_hil.api.law import Law
from gfm_hil.api.tuned_law import problem_name, write_law
from gfm_hil.cli.common import EXIT_OTHERWISE, watching
from gfm_hil.cli.design.common import (
    add_judged_on,
    add_law_options,
    channels_as_json,
    chosen_law,
    judged,
    judged_on,
    print_channels,
    read_gains,
    singular_is_users,
)
from gfm_hil.core.errors import UserError
from gfm_hil.core.terminal import terminal
from gfm_hil.scenario import Scenario


def add(kinds: Any) -> None:
    command = kinds.add_parser("tune", help="choose the free gains for the least gamma")
    add_law_options(command)
    add_judged_on(command)
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
    command.add_argument(
        "--decay", type=float, default=0.0, metavar="A",
        help="every mode of the loop must decay at least this fast, 1/s",
    )  # fmt: skip
    command.add_argument("--full-order", action="store_true", help="also compute a lower bound")
    command.add_argument("-o", "--out", help="write the tuned law to this file")
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")
    command.set_defaults(call=call)


@singular_is_users
def call(options: argparse.Namespace) -> int:
    """Tune a law's free gains; exit code 3 if no stabilising ones are found."""
    if options.out and not Path(options.out).parent.is_dir():
        raise UserError(f"--out {options.out}: {Path(options.out).parent} is no folder")
    law, on = Law(chosen_law(options)), judged_on(options)
    if options.full_order and on is not None:
        raise UserError("--full-order: the bound is that of the paper's problem; omit --scenario")
    if options.full_order and law.file.inner is not None:
        raise UserError("--full-order: the bound is that of a law on the bridge; use --inner none")
    try:
        found = _searched(law, on, options)
    except NotTuned as none:
        if options.json:
            print(json.dumps({"law": law.name, "gamma": None, "reason": str(none)}))
        else:
            terminal(stderr=True).print(f"{law.name}: {none}", highlight=False, soft_wrap=True)
        return EXIT_OTHERWISE
    named, channels = found.gains, found.gamma.channels
    result = {
        "law": law.name,
        **channels_as_json(channels),
        "gamma_full_order": None,
        "gains": named,
        "at_bounds": found.at_bounds,
        "seconds": found.seconds,
        "evaluations": found.evaluations,
        "seed": found.seed,
    }
    said = _bound(found, result) if options.full_order else ""
    if options.out:
        problem = None if on is None else problem_name(law.file, on, options.converter)
        write_law(Path(options.out), law.file, named, result, problem=problem)
    if options.json:
        print(json.dumps(result, indent=2))
        return 0
    print_channels(judged(law.file, on, options.converter), channels)
    lines = [
        ", ".join(f"{n} = {v:.6g}" for n, v in named.items()),
        f"{found.evaluations} evaluations in {found.seconds:.1f} s, seed {found.seed}"
        + (f"; law file: {options.out}" if options.out else ""),
        *(f"{n} is at its bound {x:g}: γ may fall beyond it" for n, x in found.at_bounds.items()),
        said,
    ]
    terminal(highlight=False, soft_wrap=True).print("\n".join(line for line in lines if line))
    return 0


def _searched(law: Law, on: Scenario | None, options: argparse.Namespace) -> Tuning:
    """The search, with a bar on stderr."""
    with watching(f"tuning {law.name}", options.quiet) as watch:
        return tune(
            law,
            start=read_gains(options.gains),
            only=None if options.only is None else options.only.split(","),
            weights=options.weights,
            on=on,
            converter=options.converter,
            decay=options.decay,
            seed=options.seed,
            evaluations=options.evaluations,
            starts=options.starts,
            watch=watch,
        )


def _bound(tuning: Tuning, result: dict[str, Any]) -> str:
    """The full-order bound into the result; what to say of it."""
    try:
        found = tuning.bound()
    except UserError as missing:
        terminal(stderr=True).print(str(missing), highlight=False, soft_wrap=True)
        return ""
    if found is None:
        return "full order: the solver came to no result in time"
    result["gamma_full_order"] = found.bound
    result["full_order_columns"] = list(found.columns)
    columns = ", ".join("not solved" if c is None else f"{c:.4g}" for c in found.columns)
    return f"no controller at all goes below {found.bound:.4g}; stack of P_ref, of ω_g: {columns}"
