"""Atomic files: written under another name, then renamed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

_PREFIX = ".part-"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; afterwards rename it to ``path``.

    The data is on disk before the rename is, so that a power failure leaves either the old file or
    the new one. If the block raises, ``path`` stays as it was.

    Raises:
        OSError: the file cannot be written; it names ``path``, not the path beside it.
    """
    part = path.with_name(f"{_PREFIX}{os.getpid()}-{path.name}")
    try:
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as problem:
        if problem.filename != str(part):
            raise
        raise OSError(problem.errno, problem.strerror, str(path)) from None
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, see ``replacing``."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def sync_folder(folder: Path) -> None:
    """Wait until the names in ``folder`` are on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unfinished(folder: Path) -> list[Path]:
    """Files in ``folder`` that a killed process was writing."""
    return sorted(folder.glob(f"{_PREFIX}*"))
