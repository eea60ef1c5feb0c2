"""gfmhil warm-up: compile all that runs call, so that the first run starts at once."""

import argparse
import time

from gfm_hil.core.terminal import terminal


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Compiles the kernel, the loops and every link into numba's cache. The cache "
        "lies beside the installed modules, or where NUMBA_CACHE_DIR says; another version of "
        "gfmhil, numba or Python, or another kind of processor, needs another warm-up."
    )
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    from gfm_hil.engine.compiling import compile_everything

    console = terminal(stderr=True, quiet=options.quiet)
    began = time.monotonic()
    compiled, total = compile_everything(lambda text: console.print(text, highlight=False))
    took = time.monotonic() - began
    print(f"{total} sets of functions are ready, {compiled} of them compiled now ({took:.0f} s)")
    return 0
