"""Background work that goes on after an exception: it is logged, and the work starts again."""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable

from gfm_hil.core.errors import UserError

PAUSE_S = 1.0
"""Pause between an exception and the next attempt: a lasting cause must not fill the log."""

_LOG = logging.getLogger(__name__)


async def supervised(name: str, work: Callable[[], Awaitable[None]]) -> None:
    """Run the work until it returns; log an exception, and start it again after ``PAUSE_S``."""
    while True:
        try:
            return await work()
        except Exception as problem:
            report(name, problem)
        await asyncio.sleep(PAUSE_S)


def attempt(name: str, work: Callable[[], None]) -> None:
    """Run the work once, as a loop of a thread does; log an exception, then pause."""
    try:
        work()
    except Exception as problem:
        report(name, problem)
        time.sleep(PAUSE_S)


def report(name: str, problem: Exception) -> None:
    """Log one line for an error of the machine, a traceback for what must be a bug of ours."""
    trace = None if isinstance(problem, (OSError, UserError)) else problem
    text = f"{name}: {problem or type(problem).__name__}; tried again in {PAUSE_S:g} s"
    _LOG.error(text, exc_info=trace)
