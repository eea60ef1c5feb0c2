"""The memory itself: made by the controller, joined by the plant, gone when the controller is.

Its header says whose it is. A process is known by its number and start time, so that what a
killed run left is told from what a living one uses. Whoever makes or joins a segment holds a lock
on the folder of all segments meanwhile; nobody holds it during a run.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import sys
from collections.abc import Iterator
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

from gfm_hil.links.shm.ring import RING

FOLDER = Path("/dev/shm")  # of shm_open(3) on Linux
PREFIX = "gfmhil-link-"

MAGIC = b"GFMHILSM"
VERSION = 1  # of everything below and of ring.py

# Header, int64: magic, version, the owner's identity; the plant's; then each ring's head. All that
# one side writes in a run is 128 bytes from what the other does: processors fetch lines in pairs.
_OWNER = struct.Struct("<8sq3q")
_PLANT = struct.Struct("<3q")
_PLANT_AT = 64
HEADS = (128, 256)  # plant to controller, controller to plant
RINGS = (512, 512 + RING)
SIZE = 512 + 2 * RING

#: process number, start in clock ticks since boot, namespace of process numbers
Identity = tuple[int, int, int]
NOBODY: Identity = (0, 0, 0)


class Refused(Exception):
    """A segment that is not to be had; says why."""


def myself() -> Identity:
    """This process."""
    start = _start(os.getpid())
    assert start is not None
    return os.getpid(), start, _namespace()


def create(name: str) -> SharedMemory:
    """Make the segment of that name, after clearing away what dead owners left.

    Raises:
        Refused: a living process has it, it is none of ours, or there is no room.
    """
    path = FOLDER / (PREFIX + name)
    with _locked():
        for other in FOLDER.glob(PREFIX + "*"):
            with contextlib.suppress(Refused, OSError):
                if _owner(other) is None:
                    other.unlink()
        if path.exists():
            owner = _owner(path)
            by = f"by another run (process {owner[0]})" if owner else "by a file of another user"
            raise Refused(f"occupied {by}")
        try:
            memory = _open(path.name, create=True, size=SIZE)
            with path.open("r+b") as file:  # a full file system would only tell by a signal
                os.posix_fallocate(file.fileno(), 0, SIZE)
        except OSError as problem:
            path.unlink(missing_ok=True)
            raise Refused(problem.strerror) from None
        _OWNER.pack_into(_buffer(memory), 0, MAGIC, VERSION, *myself())
    return memory


def join(name: str) -> SharedMemory | None:
    """Join the segment of that name as the plant; None if no living controller has made it yet.

    Raises:
        Refused: it has another layout, is none of ours, or another living plant has joined it.
    """
    path = FOLDER / (PREFIX + name)
    if not path.exists():
        return None
    with _locked():
        if not path.exists() or _owner(path) is None:
            return None
        with path.open("rb") as file:
            content = file.read(_PLANT_AT + _PLANT.size)
        version = _OWNER.unpack_from(content)[1]
        if version != VERSION:
            raise Refused(f"made by another version (layout {version}, ours is {VERSION})")
        plant: Identity = _PLANT.unpack_from(content, _PLANT_AT)
        if _lives(plant):
            raise Refused(f"another plant has joined it (process {plant[0]})")
        memory = _open(path.name)
        _PLANT.pack_into(_buffer(memory), _PLANT_AT, *myself())
    return memory


def leave(memory: SharedMemory) -> None:
    """Undo ``join``; another plant may come, unless the controller was killed: then it goes."""
    path = FOLDER / memory.name
    _PLANT.pack_into(_buffer(memory), _PLANT_AT, *NOBODY)
    with _locked(), contextlib.suppress(Refused, FileNotFoundError):
        if _owner(path) is None:
            path.unlink()
    memory.close()


def remove(memory: SharedMemory) -> None:
    """Undo ``create``; a plant that has joined keeps the memory until it leaves."""
    path = FOLDER / memory.name
    with _locked(), contextlib.suppress(Refused, FileNotFoundError):
        if _owner(path) == myself():
            path.unlink()
    memory.close()


@contextlib.contextmanager
def _locked() -> Iterator[None]:
    handle = os.open(FOLDER, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _open(name: str, **how: Any) -> SharedMemory:
    """Without the resource tracker, which would remove it when any of its users ends."""
    if sys.version_info >= (3, 13):
        return SharedMemory(name, track=False, **how)
    memory = SharedMemory(name, **how)
    resource_tracker.unregister(f"/{memory.name}", "shared_memory")
    return memory


def _buffer(memory: SharedMemory) -> memoryview:
    assert memory.buf is not None
    return memory.buf


def _owner(path: Path) -> Identity | None:
    """The living owner of a segment, None if it is dead. To be called under the lock.

    Raises:
        Refused: it cannot be read or is none of ours.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_OWNER.size)
    except PermissionError:
        raise Refused("belongs to another user") from None
    if not content.strip(b"\0"):
        return None  # its maker was killed while it held the lock
    if len(content) < _OWNER.size or not content.startswith(MAGIC):
        raise Refused(f"{path} is there and is no link of ours")
    owner: Identity = _OWNER.unpack(content)[2:]
    return owner if _lives(owner) else None


def _lives(who: Identity) -> bool:
    """Whether that process runs, as far as we can see: from within a container we cannot."""
    if who == NOBODY:
        return False
    return who[2] != _namespace() or _start(who[0]) == who[1]


def _namespace() -> int:
    return Path("/proc/self/ns/pid").stat().st_ino


def _start(pid: int) -> int | None:
    """When a process began, proc_pid_stat(5) field 22; None if it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        return None
    return None if fields[0] in "ZX" else int(fields[19])
