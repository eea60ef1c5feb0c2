"""gfmhil design: one module a command."""

from __future__ import annotations

from typing import Any

from gfm_hil.cli.design import box, compare, deploy, gamma, margins, tune


def add(commands: Any) -> None:
    """Add the command and its sub-commands to the parser."""
    command = commands.add_parser("design")
    kinds = command.add_subparsers(dest="design", required=True, metavar="WHAT")
    for module in (gamma, margins, tune, box, deploy, compare):
        module.add(kinds)
