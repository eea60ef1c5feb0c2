"""The file of a shared-memory link: the controller creates and removes it, the plant joins it.

It is in the private folder of the user, so that no other user can make, open, replace or lock it.
The header says which process made it. A process is identified by its number and start time, which
distinguishes the segment of a killed run from one in use. A process locks the folder while it
makes, joins or removes a segment; no process holds the lock during a run.
"""

import contextlib
import fcntl
import mmap
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gfm_hil.core import temporary as scratch
from gfm_hil.links.ring import RING

PREFIX = "link-"

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
    """A segment that this process has mapped."""

    path: Path  # of its file
    memory: mmap.mmap  # ``SIZE`` bytes

    @property
    def plant(self) -> Identity:
        """The plant that has joined last; ``NOBODY`` if none has joined or it has left."""
        plant: Identity = _PLANT.unpack_from(self.memory, _PLANT_AT)
        return plant


def create(name: str) -> Segment:
    """Make the segment of that name, after removing the segments of dead owners. Raises Refused: a
    living process uses it, the file is not a segment of ours, or there is no room."""
    with _locked() as folder:
        path = folder / (PREFIX + name)
        for other in folder.glob(PREFIX + "*"):
            with contextlib.suppress(Refused, OSError):
                if _owner(other) is None:
                    other.unlink()
        if path.exists() and (owner := _owner(path)):
            raise Refused(f"occupied by another run (process {owner[0]})")
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.posix_fallocate(handle, 0, SIZE)  # else a full file system shows up as SIGBUS
            segment = Segment(path, mmap.mmap(handle, SIZE))
        except OSError as problem:
            path.unlink()
            raise Refused(problem.strerror) from None
        finally:
            os.close(handle)
        _OWNER.pack_into(segment.memory, 0, MAGIC, VERSION, *myself())
        return segment


def join(name: str) -> Segment | None:
    """Join the segment of that name as the plant; None if no living controller has made it yet.
    Raises Refused: it has another layout, is not a segment of ours, or another living plant has
    joined it."""
    path = _folder() / (PREFIX + name)
    if not path.exists():  # a plant that waits locks nothing
        return None
    with _locked():
        if not path.exists() or _owner(path) is None:
            return None
        with path.open("r+b") as file:
            version = _OWNER.unpack(file.read(_OWNER.size))[1]
            if version != VERSION:
                raise Refused(f"made by another version (layout {version}, ours is {VERSION})")
            if path.stat().st_size < SIZE:
                raise Refused(f"{path} is there and is no link of ours")
            segment = Segment(path, mmap.mmap(file.fileno(), SIZE))
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
    with contextlib.suppress(Refused, OSError), _locked():
        if _owner(segment.path) == owner:
            segment.path.unlink()
    segment.memory.close()


@contextlib.contextmanager
def _locked() -> Iterator[Path]:
    """The user's private folder, locked. Raises Refused: it is not private, or another process
    keeps it locked."""
    folder = _folder()
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        scratch.lock(handle, fcntl.LOCK_EX)
        yield folder
    except TimeoutError as problem:
        raise Refused(f"{folder}: {problem}") from None
    finally:
        os.close(handle)


def _folder() -> Path:
    try:
        return scratch.private_folder()
    except PermissionError as problem:
        raise Refused(str(problem)) from None


def _owner(path: Path) -> Identity | None:
    """The living owner of a segment; None if the owner is dead. Raises Refused: the file is not a
    segment of ours."""
    with path.open("rb") as file:
        content = file.read(_OWNER.size)
    if not content.strip(b"\0"):
        return None  # its creator was killed before it wrote the header
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
