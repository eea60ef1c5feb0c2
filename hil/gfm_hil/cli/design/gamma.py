"""gfmhil design gamma: gamma of given gains, channel by channel."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

from gfm_design.norms.hinf import Unstable
from gfm_design.tuning.gains import FreeGain, tied
from gfm_design.tuning.paper_problem import PaperProblem
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
from gfm_runtime import law_file


def add(kinds: Any) -> None:
    """Add the command to the parser."""
    command = kinds.add_parser("gamma", help="gamma of a law's gains, channel by channel")
    add_law_options(command)
    command.add_argument(
        "--discrete",
        action="store_true",
        help="of the loop sampled at 10 kHz: law and weights by Tustin, no delay",
    )
    command.set_defaults(call=call)


@singular_is_users
def call(options: argparse.Namespace) -> int:
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
    problem = PaperProblem(file, tuple(gains), weights=weights_of(options))
    channels_of = problem.sampled_channels if options.discrete else problem.channels
    try:
        channels = channels_of(np.array([g.start for g in gains]))
    except Unstable as found:
        if options.json:
            print(json.dumps({"law": file.name, "gamma": None, "reason": str(found)}))
        else:
            terminal().print(f"{file.name}: no gamma, {found}", highlight=False)
        return EXIT_OTHERWISE
    if options.json:
        print(json.dumps({"law": file.name, **channels_as_json(channels)}, indent=2))
    else:
        print_channels(file.name, channels)
    return 0
