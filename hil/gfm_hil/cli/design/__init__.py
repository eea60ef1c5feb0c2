"""gfmhil design: one module a command, or several that are alike."""

import argparse

from gfm_hil.cli.design import bus, gains, latency, loop, margins, share, sweep, transients
from gfm_hil.core.errors import UserError

#: commands of version 0.1 that are scripts of the repository now; the note goes with version 2
_MOVED = {"compare": "law_comparison", "box": "deployable check", "deploy": "deployable tune"}


def add(command: argparse.ArgumentParser) -> None:
    kinds = command.add_subparsers(dest="design", required=True, metavar="WHAT")
    for module in (gains, margins, latency, loop, sweep, bus, share, transients):
        module.add(kinds)
    for name in _MOVED:
        moved = kinds.add_parser(name, add_help=False, prefix_chars="\0")  # any option is a word
        moved.add_argument("words", nargs="*")
        moved.set_defaults(call=_moved)


def _moved(options: argparse.Namespace) -> int:
    to = _MOVED[options.design]
    raise UserError(
        f"design {options.design}: is a script now: in examples/paper of the repository, "
        f"python -m {to} takes the same options"
    )
