"""Argument parsing and exit codes.

0: done, and a run ended as its scenario expects; 2: wrong input, nothing started; 3: a run ended
otherwise; 130: interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

from gfm_hil.cli import campaign, compare, design, laws, run, scenarios, sides
from gfm_hil.errors import UserError
from gfm_plant import NoEquilibrium
from gfm_runtime import LawError


def parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    top = argparse.ArgumentParser(
        prog="gfmhil", description="Hardware-in-the-loop bench for grid-forming converter control."
    )
    top.add_argument("--version", action="version", version=f"gfmhil {version('gfmhil')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in (run, compare, campaign, laws, design, scenarios, sides):
        module.add(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    options = parser().parse_args(arguments)
    try:
        return int(options.call(options))
    except (UserError, LawError, NoEquilibrium) as problem:
        print(f"gfmhil: {problem}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # a reader such as head that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to flush
        return 0
