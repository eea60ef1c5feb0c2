"""gfmhil design: one module a command, or several that are alike."""

from __future__ import annotations

from typing import Any

from gfm_hil.cli.design import box, compare, deploy, gamma, loop, margins, tune


def add(commands: Any) -> None:
    """Add the command and its sub-commands to the parser."""
    command = commands.add_parser("design")
    kinds = command.add_subparsers(dest="design", required=True, metavar="WHAT")
    for module in (gamma, margins, loop, tune, box, deploy, compare):
        module.add(kinds)
