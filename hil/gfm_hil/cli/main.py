"""Argument parsing and exit codes.

0: done, and a run ended as its scenario expects; 2: wrong input, nothing started; 3: a run ended
otherwise, or its folder could not be completed; 130: interrupted.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version

from gfm_hil.core.errors import Unfinished, UserError
from gfm_plant import NoEquilibrium
from gfm_runtime import LawError
from gfm_runtime.errors import printable

#: the module of each command; only the one that is called is imported, so that a side of a run
#: starts without the design tools
MODULES = {
    "run": "run",
    "tell": "tell",
    "recover": "recover",
    "scope": "scope",
    "modbus": "modbus",
    "export": "export",
    "stream": "stream",
    "compare": "compare",
    "campaign": "campaign",
    "bench": "bench",
    "laws": "laws",
    "design": "design",
    "dbc": "dbc",
    "doctor": "doctor",
    "scenarios": "scenarios",
    "keys": "keys",
    "deploy": "deploy",
    "controller": "sides",
    "plant": "sides",
}


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser of one command; of all of them if it is None or unknown."""
    top = argparse.ArgumentParser(
        prog="gfmhil", description="Hardware-in-the-loop bench for grid-forming converter control."
    )
    top.add_argument("--version", action="version", version=f"gfmhil {version('gfmhil')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    wanted = [MODULES[command]] if command in MODULES else dict.fromkeys(MODULES.values())
    for module in wanted:
        import_module(f"gfm_hil.cli.{module}").add(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    for text in given:
        if re.fullmatch("--[a-zA-Z_-]+=--", text):  # of which argparse makes an empty list
            return _refuse(f"{text}: -- cannot be a value; for a file of that name write ./--")
    options = parser(given[0] if given else None).parse_args(given)
    try:
        return int(options.call(options))
    except (UserError, LawError, NoEquilibrium) as problem:
        return _refuse(str(problem))
    except Unfinished as problem:
        _refuse(str(problem))
        return 3
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:  # a reader such as head that has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to flush
        return 0
    except OSError as problem:
        if problem.filename is None:  # not about a file that the user named
            raise
        return _refuse(f"{problem.filename}: {problem.strerror}")


def _refuse(problem: str) -> int:
    """Print what is wrong, one line a mistake; returns the exit code."""
    said = "\n".join(printable(line) for line in problem.split("\n"))
    print(f"gfmhil: {said}", file=sys.stderr)
    return 2
