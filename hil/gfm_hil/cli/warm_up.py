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
    command.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO",
        help="compile what these call, as they are written, and nothing else",
    )  # fmt: skip
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    from gfm_hil.engine.compiling import compile_everything, compiled_benches
    from gfm_hil.scenario.loading import load_scenario

    console = terminal(stderr=True, quiet=options.quiet)
    began = time.monotonic()
    said: list[str] = []

    def notice(text: str) -> None:
        said.append(text)
        console.print(text, highlight=False)

    if options.scenarios:
        for scenario in [load_scenario(given) for given in options.scenarios]:
            compiled_benches(scenario, notice)
        ready = f"{len(options.scenarios)} scenarios are"
    else:
        ready = f"{compile_everything(notice)[1]} sets of functions are"
    took = time.monotonic() - began
    print(f"{ready} ready; sets of functions compiled now: {len(said)} ({took:.0f} s)")
    return 0
