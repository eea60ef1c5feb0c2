"""Makes signals.npz and timing.npz from the parts of both roles."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.roles import ROLES, Role
from gfm_hil.recording.columns import CONTROLLER_COLUMNS, COUNTS_OF, kept_of, recorded_in
from gfm_hil.recording.npz import BLOCK, ColumnGroup, write_npz
from gfm_hil.recording.parts import FLOWS, RolePart, map_file, place_of
from gfm_runtime.assembly import SPARE
from gfm_runtime.signals import NY

_AT_ONCE = 64  # columns


def _rows(file: Path, first: int, last: int, columns: slice = slice(None)) -> NDArray[Any]:
    """Rows of a part's file, shape (columns, last - first); mapped only while they are read."""
    return np.ascontiguousarray(map_file(file)[first:last, columns].T)


def _blocks(rows: int) -> Iterator[tuple[int, int]]:
    return ((first, min(first + BLOCK, rows)) for first in range(0, rows, BLOCK))


def _last_recorded(file: Path, ticks: int) -> int:
    """Ticks up to the last one that was recorded."""
    for first, last in reversed([*_blocks(ticks)]):
        rows = np.flatnonzero(~np.isnan(_rows(file, first, last)[NY]))  # written last by a plant
        if len(rows):
            return first + int(rows[-1]) + 1
    return 0


def merge(folder: Path, T_s: float, laws: list[str]) -> None:
    """Write signals.npz and timing.npz from the parts, which stay.

    Rows end where the plant's recording does (where it is missing, the controller's). Each part is
    read once; memory is that of a few blocks of rows. Raises OSError: a file cannot be written; it
    is then not there. Raises UserError: a part is damaged, or ``parts`` is a link to anything but a
    recording.
    """
    parts = {role: part for role in ROLES if (part := RolePart.read(folder, role)) is not None}
    place = place_of(folder) or folder
    files = {role: place / f"{role}_signals.npy" for role in parts}
    counts = {role: _last_recorded(files[role], len(part.signals)) for role, part in parts.items()}
    done = counts.get("plant") or counts.get("controller", 0)
    columns = {role: recorded_in(role, part.signals.shape[1]) for role, part in parts.items()}
    names = parts["plant"].names if "plant" in parts else ()
    of_network = _of_network(place / FLOWS, names, done)
    write_npz(folder / "signals.npz", _signals(files, columns, done, T_s, laws, of_network))
    write_npz(folder / "timing.npz", _timing(place, [*parts], done))


def _signals(
    files: dict[Role, Path],
    columns: dict[Role, tuple[str, ...]],
    done: int,
    T_s: float,
    laws: list[str],
    of_network: Iterable[ColumnGroup],
) -> Iterator[ColumnGroup]:
    kinds: dict[str, np.dtype[Any]] = {"tick": np.dtype(np.int64), "t": np.dtype(float)}

    def clock(first: int, last: int) -> list[NDArray[Any]]:
        ticks = np.arange(first, last)
        return [ticks, ticks * T_s]

    yield ColumnGroup(kinds, done, clock)
    used = 0

    def rows(file: Path, law: int | None) -> Callable[[int, int], NDArray[Any]]:
        def read(first: int, last: int) -> NDArray[Any]:
            nonlocal used
            found = _rows(file, first, last)
            if law is not None:
                used = max(used, laws_used(found[law]))
            return found

        return read

    if "plant" in files:
        kinds = dict.fromkeys(columns["plant"], np.dtype(float))
        yield ColumnGroup(kinds, done, rows(files["plant"], None))
    if "controller" in files:
        kinds = dict.fromkeys(columns["controller"], np.dtype(float))
        yield ColumnGroup(kinds, done, rows(files["controller"], CONTROLLER_COLUMNS.index("law")))
    yield from of_network
    yield ColumnGroup.of(laws=np.array(known_laws(laws, used)))


def _of_network(file: Path, names: Sequence[str], done: int) -> Iterator[ColumnGroup]:
    """The columns of a network, a few at a time: each is kept in memory while it is written."""
    for k in range(0, len(names), _AT_ONCE):
        kinds = dict.fromkeys(names[k : k + _AT_ONCE], np.dtype(float))
        yield ColumnGroup(kinds, done, partial(_rows, file, columns=slice(k, k + _AT_ONCE)))


def _timing(parts: Path, roles: list[Role], done: int) -> Iterator[ColumnGroup]:
    """The times of each side that recorded some, and what it counted."""
    for role, counts in COUNTS_OF.items():
        if role not in roles:
            continue
        file, names = parts / f"{role}_times.npy", kept_of(role)
        known = np.zeros(len(names), bool)
        for a, b in _blocks(done):
            known |= (_rows(file, a, b) >= 0).any(axis=1)
        if not known[len(names) - len(counts) :].any():
            names = names[: len(names) - len(counts)]
        if known.any():
            kinds = {f"{role}_{name}": np.dtype(np.int64) for name in names}
            yield ColumnGroup(kinds, done, partial(_rows, file, columns=slice(len(kinds))))


def laws_used(indices: NDArray[Any]) -> int:
    """The highest index in a column ``law``, plus one; the column is NaN where nothing ran."""
    return int(np.nanmax(indices, initial=-1)) + 1


def known_laws(labels: list[str], used: int) -> list[str]:
    """The labels of the scenario's laws and of those that events have made of them: a controller
    has room for more, which nothing refers to."""
    return labels[: max(used, len(labels) - SPARE)]
