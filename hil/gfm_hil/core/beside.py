"""Work that a forked process does while this one goes on."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from gfm_runtime.children import end_with_parent, may_fork

_PATIENCE_S = 5.0  # for work whose block has failed


@contextmanager
def beside(work: Callable[..., object], *arguments: Any) -> Iterator[None]:
    """Do work that only writes files, on another processor if one may be had, during a block; it is
    done, or has ended, after the block. A process with other threads is not forked.

    Raises:
        Exception: what ``work`` raises, after the block.
    """
    if not may_fork() or (os.cpu_count() or 1) < 2:
        yield
        work(*arguments)
        return
    process = get_context("fork").Process(target=_quietly, args=(work, *arguments))
    process.start()
    try:
        yield
    except BaseException as problem:
        if isinstance(problem, Exception):
            process.join(_PATIENCE_S)  # it may be about to finish a file
        process.kill()
        raise
    finally:
        process.join()
    if process.exitcode:  # once more, where its error can be told
        work(*arguments)


def _quietly(work: Callable[..., object], *arguments: Any) -> None:
    """End this process after the work, without a word and without what others do at an exit."""
    end_with_parent(by=signal.SIGKILL)
    code = 1
    try:
        work(*arguments)
        code = 0
    finally:
        os._exit(code)
