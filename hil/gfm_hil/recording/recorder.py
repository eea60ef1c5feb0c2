"""Recording every tick, on disk from the first one, so that nothing recorded is ever lost.

Each side writes its rows into arrays that are memory-mapped files in the run folder: what was
written survives the process, however it ends. ``merge`` makes ``signals.npz`` and ``timing.npz``
of these parts. Columns are generated from the signal table.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import SIDES, Side
from gfm_hil.realtime.atomics import prefetch
from gfm_hil.recording.npz import BLOCK, Column, Table, open_npz, write_npz
from gfm_plant import TRUTH, plant_truth
from gfm_runtime.assembly import SPARE
from gfm_runtime.compiled import compiled
from gfm_runtime.signals import NU, NY, REF_NAMES, U_NAMES, Y_NAMES

PLANT_COLUMNS = (
    *(f"y_{n}" for n in Y_NAMES),  # what the A/D read
    *(f"u_{n}" for n in U_NAMES),  # the input in hand for this tick
    *(f"true_{n}" for n in TRUTH),  # the plant itself, without sensors
)
CONTROLLER_COLUMNS = (
    *(f"ref_{n}" for n in REF_NAMES),
    "law",  # index into `laws` of signals.npz
    "state",  # of the controller, gfm_runtime.controller.STATES
    "X_est",  # estimated grid reactance of a scheduled law, p.u.
)
# ns of CLOCK_MONOTONIC, -1: never; in lockstep a sample late, an answer is "received" at the look
# that finds the next frame "sent"; "stall" is the longest gap between two looks at the clock
PLANT_TIMES = ("scheduled", "woke", "sent", "received", "stall")
CONTROLLER_TIMES = ("scheduled", "received", "computed", "sent", "stall")

_TRUE = NY + NU
_SOON = 8  # rows; a page that is new to the processor would hold up the tick that begins it
_MEMORY = Path("/dev/shm")
_PREFIX = "gfmhil-parts-"
_FILES = frozenset(f"{s}_{what}.npy" for s in SIDES for what in ("signals", "times", "progress"))
_HOME = "home"  # in a folder in memory, a link back to the ``parts`` of its run
_holds: dict[Path, int] = {}  # on folders in memory, by the ``parts`` that links to them


@compiled
def record_sample(row, y, par, st):
    """What a row of PLANT_COLUMNS knows when the plant is sampled."""
    prefetch(row.ctypes.data + _SOON * row.nbytes)
    for j in range(NY):
        row[j] = y[j]
    plant_truth(par, st, row[_TRUE:])


@compiled
def record_command(row, u):
    """The rest of the row, once u is in hand."""
    for j in range(NU):
        row[NY + j] = u[j]


@compiled
def record_controller(row, ctl, est):
    """One row of CONTROLLER_COLUMNS."""
    prefetch(row.ctypes.data + _SOON * row.nbytes)
    c = ctl[0]
    for j in range(NY):
        row[j] = c.ref[j]
    row[NY] = c.active
    row[NY + 1] = c.state
    row[NY + 2] = est[0].X


@dataclass
class Part:
    """One side's arrays: ``signals`` (ticks, columns) float64, NaN where not yet recorded,
    ``times`` (ticks, columns) int64 in ns, -1 where nothing happened, and ``progress``
    (ticks done; plant: misses, controller: why it is in SAFE) for whoever watches."""

    signals: NDArray[np.float64]
    times: NDArray[np.int64]
    progress: NDArray[np.int64]

    @staticmethod
    def create(folder: Path, side: str, ticks: int) -> Part:
        """New files in ``folder``/parts, filled so that no page is first touched in the loop."""
        columns, times = _layout(side)
        parts = folder / "parts"
        parts.mkdir(parents=True, exist_ok=True)  # may be a link, see ``keep_in_memory``

        def mapped(what: str, dtype: str, shape: tuple[int, ...], fill: float) -> Any:
            path = parts / f"{side}_{what}.npy"
            try:
                array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)
                with path.open("r+b") as file:  # a page that is not to be had would end the process
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
            except OSError as problem:
                raise UserError(f"{path.parent.resolve()}: {problem.strerror}") from None
            array[:] = fill
            return np.asarray(array)  # a memmap's own indexing costs microseconds

        return Part(
            mapped("signals", "f8", (ticks, len(columns)), np.nan),
            mapped("times", "i8", (ticks, len(times)), -1),
            mapped("progress", "i8", (2,), 0),
        )

    @staticmethod
    def open(folder: Path, side: str) -> Part | None:
        """The files of a side as they are, or None if that side never came so far, or one of them
        is damaged."""
        try:
            arrays = [
                np.load(folder / "parts" / f"{side}_{what}.npy", mmap_mode="r")
                for what in ("signals", "times", "progress")
            ]
        except Exception:  # not there, or just being made; numpy has no common base for its errors
            return None
        signals, times, progress = arrays
        columns, names = _layout(side)
        kinds = (signals.dtype, times.dtype, progress.dtype) == ("f8", "i8", "i8")
        widths = (signals.shape[1:], times.shape[1:]) == ((len(columns),), (len(names),))
        whole = kinds and widths and progress.shape == (2,) and len(signals) == len(times)
        return Part(*arrays) if whole and 0 <= progress[0] <= len(signals) else None


def _layout(side: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The columns of a side's ``signals`` and ``times``."""
    if side == "plant":
        return PLANT_COLUMNS, PLANT_TIMES
    return CONTROLLER_COLUMNS, CONTROLLER_TIMES


def keep_in_memory(
    folder: Path, ticks: int, notice: Callable[[str], None] = lambda text: None
) -> None:
    """Have the parts of a run lie in memory until they are merged, if there is room.

    A page of a file on a disk is write-protected while it is written back: a loop that touches it
    waits for the disk. ``folder``/parts becomes a link. Every process of the run calls this, and
    then holds the place until it removes the parts or ends. What a run whose processes were
    all killed has left is first moved to its own folder, or stays, and ``notice`` is told where:
    nothing recorded is lost.

    Raises:
        UserError: ``folder``/parts is a link, but not one of our user to a place in memory.
    """
    if not _MEMORY.is_dir():
        return
    _rescue(notice)
    columns = (PLANT_COLUMNS, CONTROLLER_COLUMNS, PLANT_TIMES, CONTROLLER_TIMES)
    needed = 8 * ticks * sum(map(len, columns))
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
            scratch.let_go(_holds.pop(parts))
    place = parts.readlink()
    ours = parts.lstat().st_uid == os.geteuid()
    if not ours or place.parent != _MEMORY or not place.name.startswith(_PREFIX):
        raise UserError(f"{parts}: is a link to {place}, not to a recording in memory of our user")
    try:
        _holds[parts] = scratch.hold(place)
    except OSError as problem:
        raise UserError(f"{parts}: {place}: {problem.strerror or problem}") from None


def _rescue(notice: Callable[[str], None]) -> None:
    """Move parts that no process uses any more to where their run is, if that can be found."""
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
        scratch.let_go(hold)


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
    """Remove what the sides recorded, wherever it lies.

    A process that is killed meanwhile leaves a rest that the next call finds.
    """
    parts = folder / "parts"
    if parts.is_dir():
        for file in parts.glob("*.npy"):
            file.unlink()
        shutil.rmtree(parts.resolve())
    if parts.is_symlink():
        parts.unlink()
    if parts in _holds:
        scratch.let_go(_holds.pop(parts))


def _rows(file: Path, first: int, last: int) -> NDArray[Any]:
    """Rows of a part's file, shape (columns, last - first); mapped only while they are read."""
    return np.ascontiguousarray(np.load(file, mmap_mode="r")[first:last].T)


def _blocks(rows: int) -> Iterator[tuple[int, int]]:
    return ((first, min(first + BLOCK, rows)) for first in range(0, rows, BLOCK))


def _recorded(file: Path, ticks: int) -> int:
    """Ticks up to the last one that was recorded."""
    for first, last in reversed([*_blocks(ticks)]):
        rows = np.flatnonzero(~np.isnan(_rows(file, first, last)[NY]))  # written last by a plant
        if len(rows):
            return first + int(rows[-1]) + 1
    return 0


def merge(folder: Path, T_s: float, laws: list[str]) -> None:
    """Write signals.npz and timing.npz from the parts, which stay.

    Rows end where the plant's recording does (where it is missing, the controller's). Each part
    is read once; memory is that of a few blocks of rows.

    Raises:
        OSError: a file cannot be written; it is then not there.
    """
    parts = {side: part for side in SIDES if (part := Part.open(folder, side)) is not None}
    files = {side: folder / "parts" / f"{side}_signals.npy" for side in parts}
    counts = {side: _recorded(files[side], len(part.signals)) for side, part in parts.items()}
    done = counts.get("plant") or counts.get("controller", 0)
    write_npz(folder / "signals.npz", _signals(files, done, T_s, laws))
    write_npz(folder / "timing.npz", _timing(folder / "parts", [*parts], done))


def _signals(files: dict[Side, Path], done: int, T_s: float, laws: list[str]) -> Iterator[Table]:
    kinds: dict[str, np.dtype[Any]] = {"tick": np.dtype(np.int64), "t": np.dtype(float)}

    def clock(first: int, last: int) -> list[NDArray[Any]]:
        ticks = np.arange(first, last)
        return [ticks, ticks * T_s]

    yield Table(kinds, done, clock)
    used = 0

    def rows(file: Path, law: int | None) -> Callable[[int, int], NDArray[Any]]:
        def read(first: int, last: int) -> NDArray[Any]:
            nonlocal used
            found = _rows(file, first, last)
            if law is not None:
                used = max(used, int(np.nanmax(found[law], initial=0)) + 1)
            return found

        return read

    if "plant" in files:
        kinds = dict.fromkeys(PLANT_COLUMNS, np.dtype(float))
        yield Table(kinds, done, rows(files["plant"], None))
    if "controller" in files:
        kinds = dict.fromkeys(CONTROLLER_COLUMNS, np.dtype(float))
        yield Table(kinds, done, rows(files["controller"], CONTROLLER_COLUMNS.index("law")))
    yield Table.of(laws=np.array(laws[: max(used, len(laws) - SPARE)]))


def _timing(parts: Path, sides: list[Side], done: int) -> Iterator[Table]:
    """The times of each side that recorded some."""
    for side, names in (("plant", PLANT_TIMES), ("controller", CONTROLLER_TIMES)):
        file = parts / f"{side}_times.npy"
        if side in sides and any((_rows(file, a, b) >= 0).any() for a, b in _blocks(done)):
            kinds = {f"{side}_{name}": np.dtype(np.int64) for name in names}
            yield Table(kinds, done, partial(_rows, file))


def read_recording(folder: Path) -> tuple[dict[str, Column], dict[str, Column], list[str]]:
    """The columns of signals.npz and of timing.npz, and the labels of the laws.

    Raises:
        OSError: a file is not there.
        UserError: a file is damaged.
    """
    signals, timing = open_npz(folder / "signals.npz"), open_npz(folder / "timing.npz")
    if "laws" not in signals:
        raise UserError(f"{folder / 'signals.npz'}: has no column laws")
    laws = [str(label) for label in signals.pop("laws")[:]]
    lengths = {name: len(column) for name, column in [*signals.items(), *timing.items()]}
    if len(set(lengths.values())) > 1:
        raise UserError(f"{folder}: the columns of the recording differ in length: {lengths}")
    return signals, timing, laws
