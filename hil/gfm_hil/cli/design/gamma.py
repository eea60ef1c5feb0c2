"""gfmhil design gamma: gamma of given gains, channel by channel."""

from __future__ import annotations

import argparse
import json
from typing import Any

from gfm_design.model.closed_loop import T_S
from gfm_design.norms.hinf import Unstable
from gfm_hil.api.design import gamma
from gfm_hil.api.law import Law
from gfm_hil.cli.common import EXIT_OTHERWISE
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
from gfm_hil.core.terminal import terminal


def add(kinds: Any) -> None:
    command = kinds.add_parser("gamma", help="gamma of a law's gains, channel by channel")
    add_law_options(command)
    add_judged_on(command)
    command.add_argument(
        "--discrete",
        action="store_true",
        help="of the loop sampled at 10 kHz: law and weights by Tustin, no delay; with an inner "
        "stage the loop is sampled in any case",
    )
    command.set_defaults(call=call)


@singular_is_users
def call(options: argparse.Namespace) -> int:
    """Report gamma of given gains; exit code 3 for an unstable loop, which has none."""
    law, given = Law(chosen_law(options)), read_gains(options.gains)
    on, converter = judged_on(options), options.converter
    if given:
        law = law.with_gains(law.name, **given)
    try:
        T_s = T_S if options.discrete else None
        channels = gamma(law, options.weights, T_s, on=on, converter=converter).channels
    except Unstable as found:
        if options.json:
            print(json.dumps({"law": law.name, "gamma": None, "reason": str(found)}))
        else:
            terminal().print(f"{law.name}: no gamma, {found}", highlight=False)
        return EXIT_OTHERWISE
    if options.json:
        print(json.dumps({"law": law.name, **channels_as_json(channels)}, indent=2))
    else:
        print_channels(judged(law.file, on, converter), channels)
    return 0
