"""Columns in an .npz file: compressed block by block, so that any rows can be read alone.

The file is what ``np.savez_compressed`` writes, and ``np.load`` reads it as any other. In addition
each block of rows is compressed by itself, and an extra field of the zip directory says where the
blocks begin. Writing and reading take the memory of a few blocks, however long the columns are.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import Archive, open_file, replacing

BLOCK = 1 << 16  # rows, at least
_BLOCKS = 4000  # at most: an extra field holds 64 KiB
# of 60 s of the paper's rig, 134 MB: level 1 leaves 47.1 MB, level 3 46.9, level 6 46.0 in 3.5
# times the time
_LEVEL = 1
_SPOOL = 1 << 20  # bytes of a column, compressed, that are kept in memory
_DENSEST = 1032  # bytes that deflate can make of one
_FIELD = 0x6667  # id of the extra field: rows a block, then where each block begins
_MEMBERS = 4096  # of a file, at most
_LARGEST = 1 << 23  # bytes of a block, or of a column of another writer, which has no blocks
#: what a damaged file raises in zipfile, zlib and here; of OSError, a place where no file goes on
_DAMAGED = (
    *(zlib.error, zipfile.BadZipFile, struct.error, ValueError, KeyError, EOFError),
    *(NotImplementedError, RuntimeError, OverflowError, OSError),
)
_LAST = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS).flush()  # ends a deflate stream


@dataclass(frozen=True)
class ColumnGroup:
    """Columns to be written that are read together."""

    columns: dict[str, np.dtype[Any]]  # their types by name
    rows: int  # their length
    # ``read(first, last)`` gives those rows of each column, in the order of ``columns``
    read: Callable[[int, int], Iterable[NDArray[Any]]]

    @staticmethod
    def of(**arrays: NDArray[Any]) -> ColumnGroup:
        """Arrays of shape (rows,)."""
        kinds = {name: x.dtype for name, x in arrays.items()}
        rows = len(next(iter(arrays.values())))
        return ColumnGroup(
            kinds, rows, lambda first, last: [x[first:last] for x in arrays.values()]
        )


def write_npz(path: Path, tables: Iterable[ColumnGroup]) -> None:
    """Write ``path`` as a whole, one table after the other, each read once from its first row on.
    Raises OSError: the file cannot be written."""
    with replacing(path) as part, part.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for table in tables:
            with contextlib.ExitStack() as stack:
                spool = partial(tempfile.SpooledTemporaryFile, _SPOOL, dir=str(path.parent))
                packed = [
                    _PackedColumn(stack.enter_context(spool()), name, kind, table.rows)
                    for name, kind in table.columns.items()
                ]
                step = _step(table.rows)
                for first in range(0, table.rows, step):
                    last = min(first + step, table.rows)
                    for column, rows in zip(packed, table.read(first, last), strict=True):
                        column.add(rows.tobytes())
                for column in packed:
                    column.move(archive, file, step)


class _PackedColumn:
    """A column while its table is read: compressed, in a file without a name if it is long."""

    def __init__(self, spool: IO[bytes], name: str, kind: np.dtype[Any], rows: int) -> None:
        self._name, self._size, self._crc = name, 0, 0
        self._starts: list[int] = []
        self._spool = spool
        header = io.BytesIO()
        about = {"descr": kind.str, "fortran_order": False, "shape": (rows,)}
        np.lib.format.write_array_header_1_0(header, about)
        self.add(header.getvalue())

    def add(self, plain: bytes) -> None:
        """Append a block of the bytes that np.load will read."""
        self._size, self._crc = self._size + len(plain), zlib.crc32(plain, self._crc)
        self._spool.write(_deflate(plain))
        self._starts.append(self._spool.tell())

    def move(self, archive: zipfile.ZipFile, file: BinaryIO, step: int) -> None:
        """Make it a member of an archive in ``file``, in blocks of ``step`` rows.

        zipfile stores the compressed bytes unchanged. Then this method corrects the member's type,
        size and CRC: in its header here, and in the directory when the archive is closed.
        """
        info = zipfile.ZipInfo(f"{self._name}.npy")
        self._spool.write(_LAST)
        self._spool.seek(0)
        with archive.open(info, "w", force_zip64=True) as member:
            shutil.copyfileobj(self._spool, member)
        self._spool.close()
        info.compress_type, info.file_size, info.CRC = zipfile.ZIP_DEFLATED, self._size, self._crc
        file.seek(info.header_offset)
        file.write(info.FileHeader(zip64=True))
        starts = self._starts[:-1]  # the header is no block
        field = struct.pack(f"<{1 + len(starts)}Q", step, *starts)
        info.extra = struct.pack("<HH", _FIELD, len(field)) + field


def _step(rows: int) -> int:
    """Rows a block."""
    return max(BLOCK, -(-rows // _BLOCKS))


def _deflate(plain: bytes) -> bytes:
    """``plain`` as blocks of a deflate stream that a reader can decompress alone."""
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(plain) + packer.flush(zlib.Z_FULL_FLUSH)


@dataclass
class Column:
    """An array of shape (rows,) in an .npz file; ``column[first:last]`` reads only those rows."""

    # path, name: file and member
    path: Path
    name: str
    # dtype, rows: of the array
    dtype: np.dtype[Any]
    rows: int
    step: int  # rows a block; ``rows`` for a file of another writer, which is read as a whole
    # where each block begins in the file, and where the last one ends, bytes
    starts: tuple[int, ...]

    def __post_init__(self) -> None:
        self._held: tuple[int, NDArray[Any]] = (-1, np.empty(0, self.dtype))

    def __len__(self) -> int:
        return self.rows

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """The rows of a slice with step 1. Raises UserError: the file is gone or damaged."""
        first, last, _ = rows.indices(self.rows)
        found = np.empty(max(0, last - first), self.dtype)
        at = first
        while at < last:
            k = at // self.step
            block = self._block(k)[at - k * self.step :][: last - at]
            found[at - first : at - first + len(block)] = block
            at += len(block)
        return found

    def _block(self, k: int) -> NDArray[Any]:
        held = self._held
        if held[0] != k:
            try:
                held = self._held = (k, self._read(k))
            except _DAMAGED as problem:
                raise UserError(f"{self.path}: {self.name} is damaged: {problem}") from None
        return held[1]

    def _read(self, k: int) -> NDArray[Any]:
        rows = min(self.step, self.rows - k * self.step)
        size = rows * self.dtype.itemsize
        with open_file(self.path) as file:
            if self.starts:
                file.seek(self.starts[k])
                packed = file.read(self.starts[k + 1] - self.starts[k])
                plain = zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, size)
            else:
                with _archive(file) as archive, archive.open(f"{self.name}.npy") as member:
                    read_header(member)
                    plain = member.read(size)
        return np.frombuffer(plain, self.dtype, rows)


def open_npz(path: Path) -> dict[str, Column]:
    """The columns of an .npz file, none of them read yet. Raises FileNotFoundError: it is not
    there; UserError: it is no regular file, or is damaged."""
    with open_file(path) as file:
        try:
            with _archive(file) as archive:
                return {c.name: c for c in (_column(path, archive, i) for i in archive.infolist())}
        except _DAMAGED as problem:
            raise UserError(f"{path} is damaged: {problem}") from None


def _archive(file: io.BufferedReader) -> zipfile.ZipFile:
    return zipfile.ZipFile(Archive(file, _MEMBERS))


def _column(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Column:
    name = info.filename.removesuffix(".npy")
    with archive.open(info) as member:
        shape, dtype = read_header(member)
    if len(shape) != 1 or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is not a compressed column")
    (rows,) = shape
    size, blocks = rows * dtype.itemsize, _field(info.extra)
    if size > _DENSEST * (info.compress_size + 1):
        raise ValueError(f"{name} cannot hold {rows} rows")
    at_once = min(rows, _step(rows) if blocks else rows) * dtype.itemsize
    if at_once > _LARGEST:
        raise ValueError(f"{name}: {at_once} bytes are to be read at once, more than {_LARGEST}")
    if not blocks:
        return Column(path, name, dtype, rows, max(1, rows), ())
    assert archive.fp is not None
    archive.fp.seek(info.header_offset + 26)  # lengths of name and extra field
    begin = info.header_offset + 30 + sum(struct.unpack("<HH", archive.fp.read(4)))
    step, *relative = struct.unpack(f"<{len(blocks) // 8}Q", blocks)
    ends = [*relative, info.compress_size]
    largest = 2 * step * dtype.itemsize + BLOCK  # compressed
    sound = step == _step(rows) and len(relative) == -(-rows // step)
    if not sound or not all(0 <= b - a <= largest for a, b in pairwise([0, *ends])):
        raise ValueError(f"{name}: its blocks are not those of {rows} rows")
    return Column(path, name, dtype, rows, step, tuple(begin + at for at in ends))


def read_header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """The shape and the type of an array that begins in an open file, as numpy writes it. Raises
    ValueError: there is none, or a recording has none of its type."""
    try:
        shape, fortran, dtype = _HEADERS[np.lib.format.read_magic(file)](file)
    except Exception as problem:  # numpy has no common base for its errors
        raise ValueError(f"is no array of numpy's: {problem}") from None
    if dtype.str not in ("<f8", "<i8") and dtype.kind != "U":
        raise ValueError(f"holds {dtype}, not numbers of 8 bytes or texts")
    if fortran or min(shape, default=0) < 0:
        raise ValueError(f"has a shape that no recording has: {shape}")
    return shape, dtype


_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def _field(extra: bytes) -> bytes:
    """The content of our extra field; empty if there is none."""
    while len(extra) >= 4:
        number, size = struct.unpack_from("<HH", extra)
        if number == _FIELD:
            return extra[4 : 4 + size]
        extra = extra[4 + size :]
    return b""
