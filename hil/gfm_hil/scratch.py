"""Folders that last as long as the processes that use them, and what killed ones have left.

Whoever uses such a folder holds a shared lock on it, which the kernel takes back however the
process ends. A folder that can be locked exclusively has been left.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


def make(prefix: str, where: Path) -> tuple[Path, int]:
    """A new folder in ``where`` and the hold on it, to be given to ``let_go``."""
    with _locked(where):  # until it is held it looks as if it had been left
        place = Path(tempfile.mkdtemp(prefix=prefix, dir=where))
        return place, hold(place)


def hold(place: Path) -> int:
    """Use a folder that another process has made."""
    handle = os.open(place, os.O_RDONLY | os.O_DIRECTORY)
    fcntl.flock(handle, fcntl.LOCK_SH)
    return handle


def let_go(handle: int) -> None:
    """Undo ``make`` or ``hold``; the folder stays."""
    os.close(handle)


@contextlib.contextmanager
def temporary(prefix: str) -> Iterator[Path]:
    """A folder among the system's temporary ones, removed in the end; so are left ones."""
    where = Path(tempfile.gettempdir())
    for left, handle in left_behind(prefix, where):
        shutil.rmtree(left, ignore_errors=True)
        let_go(handle)
    place, handle = make(prefix, where)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        let_go(handle)


def held(place: Path) -> bool:
    """Whether a process uses a folder.

    Raises:
        OSError: it cannot be told, for example because there are no descriptors left.
    """
    try:
        handle = os.open(place, os.O_RDONLY | os.O_DIRECTORY)
    except FileNotFoundError:  # it is gone
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


def left_behind(prefix: str, where: Path) -> Iterator[tuple[Path, int]]:
    """Folders of ours that nobody uses any more, each with a hold that keeps others from it."""
    for place in sorted(where.glob(f"{prefix}*")):
        try:
            handle = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:  # another user's, or just removed
            continue
        try:
            with _locked(where):
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            let_go(handle)
            continue
        yield place, handle


@contextlib.contextmanager
def _locked(where: Path) -> Iterator[None]:
    handle = os.open(where, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
