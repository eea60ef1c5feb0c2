"""Check a law in the box of real loops, or tune one for it.

Usage, in examples/paper:  python -m deployable check|tune --law NAME …   (--help lists the options)
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from deployable import check, tune
from gfm_hil.core.errors import UserError
from gfm_runtime import LawError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command; returns the exit code."""
    command = argparse.ArgumentParser(prog="python -m deployable", description=__doc__)
    kinds = command.add_subparsers(required=True, metavar="WHAT")
    check.add(kinds)
    tune.add(kinds)
    options = command.parse_args(arguments)
    try:
        code: int = options.call(options)
    except (UserError, LawError) as problem:
        print(f"deployable: {problem}", file=sys.stderr)
        return 2
    return code


if __name__ == "__main__":
    raise SystemExit(main())
