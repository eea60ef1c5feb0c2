"""Temporary folders that exist while a process uses them, and those that killed processes left.

A process that uses such a folder holds a shared lock on it, which the kernel releases however the
process ends. If a folder can be locked exclusively, no process uses it any more. Only folders and
files of our own user are locked, read or removed: another user may put anything beside them, under
any name, and may hold a lock on any file that that user can open.
"""

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

MEMORY = Path("/dev/shm")  # of shm_open(3) on Linux
PATIENCE_S = 10.0  # a process of ours holds an exclusive lock for milliseconds
_LOOK_S = 0.01
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW


def is_private(found: os.stat_result) -> bool:
    """Whether a file or folder belongs to our user and no other user has any access to it."""
    return found.st_uid == os.geteuid() and not found.st_mode & 0o077


def private_folder() -> Path:
    """The folder of our user in memory, made if it is not there; nobody else has any access to it.
    Raises PermissionError: what is there belongs to another user, is open to others or no
    folder."""
    place = MEMORY / f"gfmhil-{os.geteuid()}"
    with contextlib.suppress(FileExistsError):
        place.mkdir(0o700)
    found = place.lstat()
    if not stat.S_ISDIR(found.st_mode) or not is_private(found):
        mode = stat.S_IMODE(found.st_mode)
        raise PermissionError(
            f"{place} is not a folder of our user alone (owner uid {found.st_uid}, mode {mode:04o})"
        )
    return place


def is_guarded(folder: os.stat_result) -> bool:
    """Whether no other user (but root) can remove or replace our user's files in a folder."""
    if folder.st_uid not in (0, os.geteuid()):
        return False
    return not folder.st_mode & 0o022 or bool(folder.st_mode & stat.S_ISVTX)


def lock(handle: int, operation: int, patience_s: float = PATIENCE_S) -> None:
    """Lock an open file or folder of our own user. Raises TimeoutError: that process keeps its lock
    for longer.

    Args:
        handle: file descriptor.
        operation: ``fcntl.LOCK_SH`` or ``fcntl.LOCK_EX``.
        patience_s: how long to wait for another process's lock, s.
    """
    give_up = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(handle, operation | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= give_up:
                text = f"another process has kept it locked for {patience_s:g} s"
                raise TimeoutError(text) from None
        time.sleep(_LOOK_S)


def make(prefix: str, where: Path) -> tuple[Path, int]:
    """Make a folder in ``where``; returns it with a lock to pass to ``release``."""
    while True:
        place = Path(tempfile.mkdtemp(prefix=prefix, dir=where))
        with contextlib.suppress(FileNotFoundError):  # removed before we locked it: try another
            return place, hold(place)


def hold(place: Path) -> int:
    """Use a folder that another process of our user has made. Raises FileNotFoundError: it is gone.
    Raises PermissionError: it belongs to another user, or is open to others. Raises TimeoutError: a
    process that removes unused folders keeps it locked."""
    handle = os.open(place, _FOLDER)
    try:
        if not is_private(os.fstat(handle)):
            raise PermissionError(f"{place} is not a folder of our user alone")
        lock(handle, fcntl.LOCK_SH)
        place.stat()  # it may have been removed meanwhile
    except BaseException:
        release(handle)
        raise
    return handle


def release(handle: int) -> None:
    """Undo ``make`` or ``hold``; the folder stays."""
    os.close(handle)


@contextlib.contextmanager
def temporary(prefix: str) -> Iterator[Path]:
    """A folder in the system's temporary folder, removed at the end; removes unused ones first."""
    where = Path(tempfile.gettempdir())
    for left, handle in left_behind(prefix, where):
        shutil.rmtree(left, ignore_errors=True)
        release(handle)
    place, handle = make(prefix, where)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        release(handle)


def held(place: Path) -> bool:
    """Whether a process uses a folder. Raises OSError: it is unknown, for example because no
    descriptors are left."""
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
    """Folders of our user that no process uses any more, each with an exclusive lock. Yields none
    if another user could replace them in ``where``."""
    parent = os.open(where, os.O_RDONLY | os.O_DIRECTORY)
    try:
        if not is_guarded(os.fstat(parent)):
            return
        for place in sorted(where.glob(f"{prefix}*")):
            try:
                handle = os.open(place.name, _FOLDER, dir_fd=parent)
            except OSError:  # a file, a link, another user's, or just removed
                continue
            try:
                if not is_private(os.fstat(handle)):
                    raise PermissionError
                lock(handle, fcntl.LOCK_EX, patience_s=0.0)
            except OSError:
                release(handle)
                continue
            yield place, handle
    finally:
        os.close(parent)


def copy_files(names: list[str], source: int, target: int) -> None:
    """Copy regular files of our user from one open folder to another, readable by our user alone.
    Raises OSError: a file does not belong to our user, or there is no room."""
    for name in names:
        handle = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=source)
        with os.fdopen(handle, "rb") as file:
            found = os.fstat(handle)
            if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid():
                raise PermissionError(f"{name} is not a file of our user")
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
            with os.fdopen(os.open(name, flags, 0o600, dir_fd=target), "wb") as copy:
                shutil.copyfileobj(file, copy, 1 << 20)
