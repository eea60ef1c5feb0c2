"""Work that a forked process does while this one goes on."""

import os
import threading
from collections.abc import Callable
from multiprocessing import get_context
from typing import Any


def beside(work: Callable[..., object], *arguments: Any) -> Callable[[], None]:
    """Begin work that only writes files, on another processor if one may be had.

    A process with other threads is not forked: a lock that one of them has would never be released
    in the copy. That of a progress bar only writes to the terminal, which ``work`` does not.

    Returns:
        What waits until it has ended, and raises what ``work`` raises.
    """

    def here() -> None:
        work(*arguments)

    others = (t for t in threading.enumerate() if type(t).__module__ != "rich.live")
    if [*others] != [threading.main_thread()] or (os.cpu_count() or 1) < 2:
        return here
    process = get_context("fork").Process(target=_quietly, args=(here,))
    process.start()

    def wait() -> None:
        process.join()
        if process.exitcode:  # once more, where its error can be told
            here()

    return wait


def _quietly(work: Callable[[], None]) -> None:
    """End this process after the work, without a word and without what others do at an exit."""
    code = 1
    try:
        work()
        code = 0
    finally:
        os._exit(code)
