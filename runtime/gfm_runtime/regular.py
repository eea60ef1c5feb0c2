"""Reading regular files only: a pipe or a device may have no end, and opening one may wait."""

import errno
import io
import os
import stat
from pathlib import Path


def open_regular(
    path: str | Path, most: int | None = None, links: bool = True
) -> io.BufferedReader:
    """Open a regular file for reading.

    Args:
        path: of the file.
        most: how large it may be, bytes.
        links: the file may be a link to the one that is opened.

    Raises:
        OSError: with ``path`` and the reason: it cannot be opened, is not regular, is larger than
            ``most``, or is a link.
    """
    # O_NONBLOCK: opening a named pipe would otherwise wait for its writer
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    try:
        handle = os.open(path, flags)
    except OSError as problem:
        if problem.errno == errno.ELOOP and not links:
            raise OSError(errno.ELOOP, "is a link, which is not followed", str(path)) from None
        if problem.errno == errno.ENXIO:  # a socket
            raise OSError(errno.ENXIO, "is not a regular file", str(path)) from None
        raise
    try:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "is not a regular file", str(path))
        if most is not None and found.st_size > most:
            raise _too_large(path, most)
    except OSError:
        os.close(handle)
        raise
    return io.BufferedReader(io.FileIO(handle, "rb"))


def read_regular(path: str | Path, most: int, links: bool = True) -> bytes:
    """The content of a regular file; arguments and errors as of ``open_regular``."""
    with open_regular(path, most, links) as file:
        data = file.read(os.fstat(file.fileno()).st_size)
        data += file.read(most + 1 - len(data)) if file.peek(1) else b""
    if len(data) > most:  # a file of /proc says that it is empty
        raise _too_large(path, most)
    return data


def _too_large(path: str | Path, most: int) -> OSError:
    size = f"{most // 2**20} MiB" if most >= 2**20 else f"{most} bytes"
    return OSError(errno.EFBIG, f"is larger than {size}", str(path))
