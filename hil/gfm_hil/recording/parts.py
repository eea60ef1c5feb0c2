"""The parts of a run: the rows that each role records, on disk or in memory.

The rows of a role are memory-mapped files in the run folder: they survive the process, however it
ends. In real time the files lie in memory until they are merged.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import open_file
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.recording.columns import PLAIN_COLUMNS, ColumnSet, kept_of, recorded_in
from gfm_hil.recording.npz import read_header

_MEMORY = Path("/dev/shm")
_PREFIX = "gfmhil-parts-"
_KINDS = ("signals", "times", "progress")
#: columns of a network and their names, beside those of the plant of its first converter
FLOWS, _NAMES = "network_signals.npy", "network_names.npy"
_FILES = frozenset((*(f"{s}_{what}.npy" for s in ROLES for what in _KINDS), FLOWS, _NAMES))
_HOME = "home"  # in a folder in memory, a link back to the ``parts`` of its run
_holds: dict[Path, int] = {}  # on folders in memory, by the ``parts`` that links to them


@dataclass
class RolePart:
    """One side's arrays: ``signals`` (ticks, columns) float64, NaN where not yet recorded,
    ``times`` (ticks, columns) int64 in ns, -1 where nothing happened, and ``progress`` for
    observers: ticks done; of the plant the misses, of the controller the reason of SAFE; and the
    thread of the loop; ``flows`` (ticks, columns) as ``signals``, of a network, with their names.
    """

    signals: NDArray[np.float64]
    times: NDArray[np.int64]
    progress: NDArray[np.int64]
    flows: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    names: tuple[str, ...] = ()

    @staticmethod
    def create(
        folder: Path, role: Role, ticks: int, columns: ColumnSet = PLAIN_COLUMNS
    ) -> RolePart:
        """New files in ``folder``/parts, filled so that no page is first touched in the loop."""
        names, times = columns.signals(role), kept_of(role)
        parts = folder / "parts"
        parts.mkdir(parents=True, exist_ok=True)  # may be a link, see ``keep_in_memory``

        def made(name: str, dtype: str, shape: tuple[int, ...], fill: float) -> Any:
            path = parts / name
            with naming(parts.resolve()):
                array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
                with path.open("r+b") as file:  # else a full disk would kill the process later
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
            array[:] = fill
            return np.asarray(array)  # a memmap's own indexing costs microseconds

        flows: tuple[str, ...] = columns.flows if role == "plant" else ()
        if flows:
            np.save(parts / _NAMES, np.array(flows))
        whole = (ticks, len(flows))
        return RolePart(
            made(f"{role}_signals.npy", "f8", (ticks, len(names)), np.nan),
            made(f"{role}_times.npy", "i8", (ticks, len(times)), -1),
            made(f"{role}_progress.npy", "i8", (3,), 0),
            made(FLOWS, "f8", whole, np.nan) if flows else np.empty(whole),
            flows,
        )

    @staticmethod
    def open(folder: Path, role: Role) -> RolePart | None:
        """The files of a role, or None if they do not exist or one of them is damaged."""
        with contextlib.suppress(UserError, OSError):  # OSError: just removed
            return RolePart.read(folder, role)
        return None

    @staticmethod
    def read(folder: Path, role: Role) -> RolePart | None:
        """The files of a role, or None if one of them does not exist. Raises UserError: a file is
        damaged, or ``parts`` is a link as of ``place_of``."""
        place = place_of(folder)
        files = [place / f"{role}_{what}.npy" for what in _KINDS] if place is not None else []
        if not files or not all(os.path.lexists(file) for file in files):
            return None
        signals, times, progress = arrays = [map_file(file) for file in files]
        types = [x.dtype.str for x in arrays] == ["<f8", "<i8", "<i8"]
        known = signals.ndim == 2 and recorded_in(role, signals.shape[1]) != ()
        widths = known and times.shape[1:] == (len(kept_of(role)),)
        whole = types and widths and progress.shape == (3,) and len(signals) == len(times)
        if not whole or not 0 <= progress[0] <= len(signals):
            raise UserError(f"{files[0]}: is no recording of a {role}, nor are those beside it")
        own = [file.with_name(name) for file in files[:1] for name in (FLOWS, _NAMES)]
        if role != "plant" or not all(os.path.lexists(file) for file in own):
            return RolePart(signals, times, progress)
        flows, names = map(map_file, own)
        shape = (len(signals), len(names)) if names.dtype.kind == "U" and names.ndim == 1 else ()
        if flows.dtype.str != "<f8" or flows.shape != shape:
            raise UserError(f"{own[0]}: is no recording of a network")
        return RolePart(signals, times, progress, flows, tuple(map(str, names)))

    def of_network(self) -> dict[str, NDArray[np.float64]]:
        """The columns of its network, as views of shape (ticks,), by their names."""
        return dict(zip(self.names, self.flows.T, strict=True))


def map_file(file: Path) -> NDArray[Any]:
    """A file of a part, memory-mapped. Raises UserError: the file is gone or damaged."""
    try:
        with open_file(file) as opened:
            shape, dtype = read_header(opened)
            return np.asarray(np.memmap(opened, dtype, "r", opened.tell(), shape))
    except (OSError, ValueError, OverflowError) as problem:
        raise UserError(f"{file}: is damaged: {problem}") from None


def check_parts(folder: Path, ticks: int) -> None:
    """See that the parts in a folder are what a run of so many ticks wrote. Raises UserError: one
    is damaged, has another length, or bytes that were never written: a run fills its files before
    it begins, and writes no zeros over a whole page."""
    for role in ROLES:
        part, place = RolePart.read(folder, role), place_of(folder)
        if part is None or place is None:
            continue
        if len(part.signals) != ticks:
            said = f"holds {len(part.signals)} ticks, but the run has {ticks}"
            raise UserError(f"{place}/{role}_signals.npy: {said}")
        for what in ("signals", "times"):
            with open_file(place / f"{role}_{what}.npy") as file:
                written = os.lseek(file.fileno(), 0, os.SEEK_HOLE)
                if written < os.fstat(file.fileno()).st_size:
                    said = f"is damaged: was never written from byte {written} on"
                    raise UserError(f"{place}/{role}_{what}.npy: {said}")


class MemoryPart:
    """One side's columns in memory, to record one run after another.

    Attributes:
        signals, flows: as of ``RolePart``, where a loop may write; None for signals of which only
            some are kept, for which there is ``put``.

    Args:
        role: whose.
        ticks: of a run.
        columns: what the run records.
        only: names of the columns that are kept beside the flows; None: all.
    """

    def __init__(
        self,
        role: Role,
        ticks: int,
        columns: ColumnSet = PLAIN_COLUMNS,
        only: Collection[str] | None = None,
    ) -> None:
        recorded = columns.signals(role)
        flows = columns.flows if role == "plant" else ()
        self._names = [name for name in recorded if only is None or name in only]
        self._places = [recorded.index(name) for name in self._names]
        shapes = (len(self._names), ticks), (len(flows), ticks)
        # all columns together are kept row by row, where the loop writes them
        order: Literal["F", "C"] = "F" if only is None else "C"
        self._columns, self._flows = (np.empty(shape, order=order) for shape in shapes)
        self._of_network = flows
        self.signals = self._columns.T if only is None else None
        self.flows = self._flows.T

    def put(self, first: int, rows: NDArray[np.float64], flows: NDArray[np.float64]) -> None:
        """Record rows of consecutive ticks, the first of which is ``first``, and the network's."""
        for column, place in zip(self._columns, self._places, strict=True):
            column[first : first + len(rows)] = rows[:, place]
        if len(self._flows):
            self._flows[:, first : first + len(rows)] = flows.T

    def by_name(self, done: int) -> dict[str, NDArray[np.float64]]:
        """The columns of the first ``done`` ticks by name, as views of shape (done,)."""
        found = dict(zip(self._names, self._columns[:, :done], strict=True))
        return found | dict(zip(self._of_network, self._flows[:, :done], strict=True))


def keep_in_memory(
    folder: Path,
    ticks: int,
    notice: Callable[[str], None] = lambda text: None,
    columns: ColumnSet = PLAIN_COLUMNS,
) -> None:
    """Keep the parts of a run in memory until they are merged, if there is room.

    The kernel write-protects a page of a file on a disk while it writes it back: a loop that
    touches the page waits for the disk. ``folder``/parts becomes a link. Every process of the run
    calls this, and then holds the place until it removes the parts or ends. Parts of a run whose
    processes were all killed are first moved to the folder of that run. If that is not possible,
    they stay, and ``notice`` is called with their place: no recording is lost. Raises UserError:
    ``folder``/parts is a link, but not one of our user to a place in memory.
    """
    if not _MEMORY.is_dir():
        return
    _rescue(notice)
    needed = columns.bytes_per_tick() * ticks
    parts = folder / "parts"
    if not parts.is_symlink():
        if shutil.disk_usage(_MEMORY).free < 2 * needed:
            return
        place, _holds[parts] = scratch.make(_PREFIX, _MEMORY)
        (place / _HOME).symlink_to(parts.absolute())
        try:
            parts.symlink_to(place)
            return
        except FileExistsError:  # another process of this run was first
            shutil.rmtree(place)
            scratch.release(_holds.pop(parts))
    place = place_of(folder) or parts.readlink()
    with naming(f"{parts}: {place}"):
        _holds[parts] = scratch.hold(place)


def place_of(folder: Path) -> Path | None:
    """Where the parts of a run lie: in ``folder``/parts, or in the folder in memory to which
    ``keep_in_memory`` has linked it; None if there is neither. Raises UserError: ``parts`` is
    something else, or a link to anything else."""
    parts = folder / "parts"
    if not parts.is_symlink():
        if os.path.lexists(parts) and not parts.is_dir():
            raise UserError(f"{parts}: is not a folder")
        return parts if parts.is_dir() else None
    if not parts.exists():
        return None
    place, ours = parts.readlink(), parts.lstat().st_uid == os.geteuid()
    named = place.parent == _MEMORY and place.name.startswith(_PREFIX)
    there = named and place.is_dir() and not place.is_symlink()
    if not ours or not there or not scratch.is_private(place.lstat()):
        raise UserError(f"{parts}: is a link to {place}, not to a recording in memory of our user")
    home = place / _HOME
    made = home.readlink() if home.is_symlink() else None
    if made is not None and made.is_symlink() and made.readlink() == place:
        if made.parent.samefile(folder):
            return place
        raise UserError(f"{parts}: is a link to {place}, the recording of {made.parent}")
    return place


def _rescue(notice: Callable[[str], None]) -> None:
    """Move parts that no process uses any more to the folder of their run, if it exists."""
    for place, hold in scratch.left_behind(_PREFIX, _MEMORY):
        with contextlib.suppress(OSError):  # no room, no rights: they stay
            recorded = sorted(_FILES.intersection(path.name for path in place.iterdir()))
            home = _home_of(place)
            if home is not None:
                run, link = home
                try:
                    _move(recorded, hold, run, link)
                finally:
                    os.close(run)
            elif recorded:
                gone = (place / _HOME).readlink().parent
                notice(
                    f"{place}: kept, the recording of a killed run whose folder {gone} is gone or "
                    "belongs to another user; move it where it belongs, or remove it"
                )
            if home is not None or not recorded:
                shutil.rmtree(place)
        scratch.release(hold)


def _home_of(place: Path) -> tuple[int, str] | None:
    """The folder of a run, opened, and the name of the link in it to a folder in memory: where it
    was made, or, if the run's folder has been renamed, beside there. None if there is no such
    folder of our user."""
    with contextlib.suppress(OSError):
        made = (place / _HOME).readlink()
        for link in (made, *sorted(made.parent.parent.glob(f"*/{made.name}"))):
            with contextlib.suppress(OSError):
                run = os.open(link.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
                ours = os.fstat(run).st_uid == os.geteuid()
                with contextlib.suppress(OSError):  # it is no link
                    if ours and os.readlink(link.name, dir_fd=run) == str(place):
                        return run, link.name
                os.close(run)
    return None


def _move(names: list[str], source: int, run: int, link: str) -> None:
    """Replace the link in a run's folder by a folder with copies of some files; every folder is
    given by its descriptor, so that no other user can put another one in its place."""
    copy = f"parts-{secrets.token_hex(4)}"
    os.mkdir(copy, 0o700, dir_fd=run)
    try:
        target = os.open(copy, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW, dir_fd=run)
        try:
            if not scratch.is_private(os.fstat(target)):
                raise PermissionError
            scratch.copy_files(names, source, target)
        finally:
            os.close(target)
        os.unlink(link, dir_fd=run)
        os.rename(copy, link, src_dir_fd=run, dst_dir_fd=run)
    except OSError:
        shutil.rmtree(copy, dir_fd=run)
        raise


def remove_parts(folder: Path) -> None:
    """Remove the parts from disk and memory.

    If the process is killed meanwhile, the next call removes the rest. Raises UserError: ``parts``
    is a link as of ``place_of``.
    """
    parts = folder / "parts"
    place = place_of(folder)
    if place is not None:
        for file in place.glob("*.npy"):
            if not file.is_dir():
                file.unlink()
        shutil.rmtree(place)
    if parts.is_symlink():
        parts.unlink()
    if parts in _holds:
        scratch.release(_holds.pop(parts))
