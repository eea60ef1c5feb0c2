"""gfmhil design: one module a command, or several that are alike."""

from __future__ import annotations

import argparse

from gfm_hil.cli.design import box, compare, deploy, gamma, loop, margins, tune


def add(command: argparse.ArgumentParser) -> None:
    """Add the sub-commands."""
    kinds = command.add_subparsers(dest="design", required=True, metavar="WHAT")
    for module in (gamma, margins, loop, tune, box, deploy, compare):
        module.add(kinds)
