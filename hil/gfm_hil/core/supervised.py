"""Work in the background that outlives its own exceptions: it is reported, and begins again."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable

from gfm_hil.core.errors import UserError

PAUSE_S = 1.0
"""Between an exception and the next attempt: a lasting cause must not fill the log."""

_LOG = logging.getLogger(__name__)


async def supervised(name: str, work: Callable[[], Awaitable[None]]) -> None:
    """Do the work until it ends by itself; one that ends by an exception begins again."""
    while True:
        try:
            return await work()
        except Exception as problem:
            _report(name, problem)
        await asyncio.sleep(PAUSE_S)


def attempt(name: str, work: Callable[[], None]) -> None:
    """Do the work once; for loops that are no tasks. An exception is reported and paused after."""
    try:
        work()
    except Exception as problem:
        _report(name, problem)
        time.sleep(PAUSE_S)


def _report(name: str, problem: Exception) -> None:
    """One line for what the machine lacks, a traceback for what must be a mistake of ours."""
    trace = None if isinstance(problem, (OSError, UserError)) else problem
    text = f"{name}: {problem or type(problem).__name__}; tried again in {PAUSE_S:g} s"
    _LOG.error(text, exc_info=trace)
