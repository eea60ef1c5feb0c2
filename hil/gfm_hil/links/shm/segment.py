"""The shared memory: the controller creates and removes it, the plant joins it.

The header says which process made it. A process is identified by its number and start time, which
distinguishes the segment of a killed run from one in use. A process locks the file while it makes,
joins or removes a segment; no process holds the lock during a run. Only files of our own user are
used, locked or removed: another user may put any file under the same name.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import stat
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.core import temporary as scratch
from gfm_hil.links.ring import RING

FOLDER = Path("/dev/shm")  # of shm_open(3) on Linux
PREFIX = "gfmhil-link-"

MAGIC = b"GFMHILSM"
VERSION = 1  # of everything below and of links/ring.py

# Header, int64: magic, version, the owner's identity; the plant's; then each ring's head. What the
# two sides write in a run is 128 bytes apart: processors fetch cache lines in pairs.
_OWNER = struct.Struct("<8sq3q")
_PLANT = struct.Struct("<3q")
_PLANT_AT = 64
HEADS = (128, 256)  # plant to controller, controller to plant
BELLS = (384, 448)  # of the rings, in the same order; seldom written
RINGS = (512, 512 + RING)
SIZE = 512 + 2 * RING

#: process id, start in clock ticks since boot, PID namespace
Identity = tuple[int, int, int]
NOBODY: Identity = (0, 0, 0)


class Refused(Exception):
    """A segment that cannot be used; the message says why."""


def myself() -> Identity:
    """The identity of this process."""
    start = _start(os.getpid())
    assert start is not None
    return os.getpid(), start, _namespace()


@dataclass(frozen=True)
class Segment:
    """A segment that this process has mapped.

    Attributes:
        path: of its file.
        memory: ``SIZE`` bytes.
    """

    path: Path
    memory: mmap.mmap

    @property
    def plant(self) -> Identity:
        """The plant that has joined last; ``NOBODY`` if none has joined or it has left."""
        plant: Identity = _PLANT.unpack_from(self.memory, _PLANT_AT)
        return plant


def create(name: str) -> Segment:
    """Make the segment of that name, after removing the segments of dead owners.

    Raises:
        Refused: a living process uses it, the file is not a segment of ours, or there is no room.
    """
    path = FOLDER / (PREFIX + name)
    for other in FOLDER.glob(PREFIX + "*"):
        with contextlib.suppress(Refused, OSError), _locked(other, patience_s=0.0) as handle:
            if handle is not None and _owner(other, handle) is None:
                other.unlink()
    while True:
        with _locked(path, os.O_CREAT) as handle:
            assert handle is not None
            found = os.fstat(handle)
            if found.st_size == 0 and scratch.is_private(found):  # no process has it in use
                return _made(path, handle)
            if owner := _owner(path, handle):
                raise Refused(f"occupied by another run (process {owner[0]})")
            path.unlink()


def _made(path: Path, handle: int) -> Segment:
    """Turn an empty file into a segment of this process."""
    try:
        os.posix_fallocate(handle, 0, SIZE)  # else a full file system shows up only as SIGBUS
    except OSError as problem:
        path.unlink()
        raise Refused(problem.strerror) from None
    segment = Segment(path, mmap.mmap(handle, SIZE))
    _OWNER.pack_into(segment.memory, 0, MAGIC, VERSION, *myself())
    return segment


def join(name: str) -> Segment | None:
    """Join the segment of that name as the plant; None if no living controller has made it yet.

    Raises:
        Refused: it has another layout, is not a segment of ours, is open to other users, or
            another living plant has joined it.
    """
    path = FOLDER / (PREFIX + name)
    with _locked(path) as handle:
        if handle is None or _owner(path, handle) is None:
            return None
        version = _OWNER.unpack(os.pread(handle, _OWNER.size, 0))[1]
        if version != VERSION:
            raise Refused(f"made by another version (layout {version}, ours is {VERSION})")
        found = os.fstat(handle)
        if not scratch.is_private(found):
            mode = stat.S_IMODE(found.st_mode)
            raise Refused(f"other users may open {path} (mode {mode:04o}, must be 0600)")
        if found.st_size < SIZE:
            raise Refused(f"{path} is there and is no link of ours")
        segment = Segment(path, mmap.mmap(handle, SIZE))
        if _lives(segment.plant):
            raise Refused(f"another plant has joined it (process {segment.plant[0]})")
        _PLANT.pack_into(segment.memory, _PLANT_AT, *myself())
    return segment


def leave(segment: Segment) -> None:
    """Undo ``join``: another plant may join. If the controller was killed, remove the segment."""
    _PLANT.pack_into(segment.memory, _PLANT_AT, *NOBODY)
    _remove_if(segment, None)


def remove(segment: Segment) -> None:
    """Undo ``create``; a plant that has joined keeps the memory until it leaves."""
    _remove_if(segment, myself())


def has_plant(segment: Segment) -> bool:
    """Whether a living plant has joined."""
    return _lives(segment.plant)


def _remove_if(segment: Segment, owner: Identity | None) -> None:
    """Unmap a segment; remove its file if its living owner is ``owner`` (None: no living one)."""
    with contextlib.suppress(Refused, OSError), _locked(segment.path) as handle:
        if handle is not None and _owner(segment.path, handle) == owner:
            segment.path.unlink()
    segment.memory.close()


@contextlib.contextmanager
def _locked(
    path: Path, flags: int = 0, patience_s: float = scratch.PATIENCE_S
) -> Iterator[int | None]:
    """The file at a path, opened and locked, or None if there is none.

    Args:
        path: of a segment.
        flags: ``os.O_CREAT`` to make an empty file if there is none.
        patience_s: how long to wait for another process's lock, s.

    Raises:
        Refused: it is not a file of our user, or another process keeps it locked.
    """
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | flags, 0o600)
        except FileNotFoundError:
            yield None
            return
        except PermissionError:
            raise Refused("belongs to another user") from None
        except OSError as problem:
            raise Refused(f"{path}: {problem.strerror}") from None
        try:
            _refuse_foreign(path, os.fstat(handle))
            try:
                scratch.lock(handle, fcntl.LOCK_EX, patience_s)
            except TimeoutError as problem:
                raise Refused(str(problem)) from None
            if _is_at(path, handle):  # the file was not replaced while we waited
                yield handle
                return
        finally:
            fcntl.flock(handle, fcntl.LOCK_UN)  # a mapping of the file would keep the lock
            os.close(handle)


def _refuse_foreign(path: Path, found: os.stat_result) -> None:
    if found.st_uid != os.geteuid():
        raise Refused(f"belongs to another user (uid {found.st_uid})")
    if not stat.S_ISREG(found.st_mode):
        raise Refused(f"{path} is there and is no link of ours")


def _is_at(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(path.lstat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _owner(path: Path, handle: int) -> Identity | None:
    """The living owner of a locked segment; None if the owner is dead.

    Raises:
        Refused: the file is not a segment of ours.
    """
    content = os.pread(handle, _OWNER.size, 0)
    if not content.strip(b"\0"):
        return None  # its creator was killed while it held the lock
    if len(content) < _OWNER.size or not content.startswith(MAGIC):
        raise Refused(f"{path} is there and is no link of ours")
    owner: Identity = _OWNER.unpack(content)[2:]
    return owner if _lives(owner) else None


def _lives(who: Identity) -> bool:
    """Whether that process runs; assume so if it is in another PID namespace (a container)."""
    if who == NOBODY:
        return False
    return who[2] != _namespace() or _start(who[0]) == who[1]


def _namespace() -> int:
    return Path("/proc/self/ns/pid").stat().st_ino


def _start(pid: int) -> int | None:
    """Start time of a process, proc_pid_stat(5) field 22; None if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in "ZX" else int(fields[19])
