"""gfmhil warm-up: compile all that runs call, so that the first run starts at once."""

import argparse
import os
import time
from collections.abc import Callable


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Compiles the kernel, the loops and every link into numba's cache, on all processors at "
        "once. The cache lies beside the installed modules, or where NUMBA_CACHE_DIR says; another "
        "version of gfmhil, numba or Python, or another kind of processor, needs another warm-up."
    )
    command.add_argument(
        "scenarios", nargs="*", metavar="SCENARIO",
        help="compile what these call, as they are written, and nothing else",
    )  # fmt: skip
    command.add_argument("--quiet", action="store_true", help="no progress on stderr")


def call(options: argparse.Namespace) -> int:
    from gfm_hil.cli.common import above, progress
    from gfm_hil.engine.compiling import compiled_benches
    from gfm_hil.scenario.loading import load_scenario

    began = time.monotonic()
    with progress("{task.description}", quiet=options.quiet) as bar:
        notice = above(bar)
        if options.scenarios:
            said: list[str] = []

            def note(text: str) -> None:
                said.append(text)
                notice(text)

            for scenario in [load_scenario(given) for given in options.scenarios]:
                compiled_benches(scenario, note)
            ready, compiled = f"{len(options.scenarios)} scenarios are", len(said)
        else:
            task = bar.add_task("")
            sets, compiled = _compile_everything(
                notice, lambda text: bar.update(task, description=text)
            )
            ready = f"{sets} sets of functions are"
    took = time.monotonic() - began
    print(f"{ready} ready; sets of functions compiled now: {compiled} ({took:.0f} s)")
    return 0


def _compile_everything(
    notice: Callable[[str], None], under_way: Callable[[str], None]
) -> tuple[int, int]:
    """Compile what any run may call, several sets at a time, and those first that others need;
    returns how many sets there are, and how many numba had to compile. Raises WorkerLost: a process
    died."""
    from concurrent.futures import FIRST_COMPLETED, Future, wait
    from concurrent.futures.process import BrokenProcessPool

    from gfm_hil.engine.compiling import Set, everything
    from gfm_hil.studies.workers import WorkerLost, processes
    from gfm_runtime.compiled import wheel_code

    waiting, working, done, compiled = everything(), dict[Future[int], Set](), set[str](), 0
    sets, workers = len(waiting), len(os.sched_getaffinity(0))
    with processes(workers) as pool:
        while waiting or working:
            ready = [one for one in waiting if done.issuperset(one.after)]
            for one in ready[: workers - len(working)]:
                waiting.remove(one)
                working[pool.submit(_compile, one.name)] = one
            names = ", ".join(one.name for one in working.values())
            under_way(f"compiling {names} ({len(done)} of {sets} are ready) …")
            for future in wait(working, return_when=FIRST_COMPLETED).done:
                one = working.pop(future)
                done.add(one.name)
                try:
                    compiled_now = future.result()
                except BrokenProcessPool:
                    words = "a process that compiles died (killed, or out of memory?)"
                    raise WorkerLost(words) from None
                if compiled_now:
                    if not compiled and (why := wheel_code().unfit):
                        notice(f"the code in this wheel is not used ({why})")
                    compiled += 1
                    notice(f"compiled {one.name} ({len(done)} of {sets}, once a machine)")
    return sets, compiled


def _compile(name: str) -> int:
    """Compile one set, in a process of its own; returns 0 if all of it was in the cache."""
    from gfm_hil.engine.compiling import compile_sets, everything

    return compile_sets([one for one in everything() if one.name == name], lambda text: None)
