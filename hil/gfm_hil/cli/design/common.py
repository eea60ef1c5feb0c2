"""What the design commands share: the inner stage and the converter of a loop."""

import argparse

from gfm_hil.cli.common import OPTIONS
from gfm_hil.scenario import Scenario, load_scenario


def add_inner_option(command: argparse.ArgumentParser) -> None:
    """The inner stage."""
    command.add_argument(
        "--inner", metavar="NAME",
        help="inner stage: a shipped name (gfmhil laws), a file, or none; the law's own by default",
    )  # fmt: skip


def add_converter_option(command: argparse.ArgumentParser) -> None:
    """The converter of a network."""
    command.add_argument(
        "--converter", metavar="NAME",
        help="of a scenario with a network: the converter whose loop it is, and that gets --law and"
        " --inner",
    )  # fmt: skip


def chosen_scenario(given: str, options: argparse.Namespace) -> Scenario:
    """A scenario with the law and the inner stage of --law and --inner; in a network those of
    --converter. Raises UserError: as ``load_scenario``; --converter does not name a converter of
    the network."""
    names = {**OPTIONS, "converter": "--converter"}
    return load_scenario(
        given, names, converter=options.converter, law=options.law, inner=options.inner
    )
