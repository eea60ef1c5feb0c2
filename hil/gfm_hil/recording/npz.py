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
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import replacing

BLOCK = 1 << 16  # rows, at least
_BLOCKS = 4000  # at most: an extra field holds 64 KiB
# of 60 s of the paper's rig, 134 MB: level 1 leaves 47.1 MB, level 3 46.9, level 6 46.0 in 3.5
# times the time
_LEVEL = 1
_SPOOL = 1 << 20  # bytes of a column, compressed, that are kept in memory
_DENSEST = 1032  # bytes that deflate can make of one
_FIELD = 0x6667  # id of the extra field: rows a block, then where each block begins
_DAMAGED = (zlib.error, zipfile.BadZipFile, struct.error, ValueError, KeyError, EOFError)
_LAST = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS).flush()  # ends a deflate stream


@dataclass(frozen=True)
class Table:
    """Columns to be written that are read together.

    Attributes:
        columns: their types by name.
        rows: their length.
        read: ``read(first, last)`` gives those rows of each column, in the order of ``columns``.
    """

    columns: dict[str, np.dtype[Any]]
    rows: int
    read: Callable[[int, int], Iterable[NDArray[Any]]]

    @staticmethod
    def of(**arrays: NDArray[Any]) -> Table:
        """Arrays of shape (rows,)."""
        kinds = {name: x.dtype for name, x in arrays.items()}
        rows = len(next(iter(arrays.values())))
        return Table(kinds, rows, lambda first, last: [x[first:last] for x in arrays.values()])


def write_npz(path: Path, tables: Iterable[Table]) -> None:
    """Write ``path`` as a whole, one table after the other, each read once from its first row on.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as part, part.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for table in tables:
            with contextlib.ExitStack() as stack:
                spool = partial(tempfile.SpooledTemporaryFile, _SPOOL, dir=str(path.parent))
                packed = [
                    _Packed(stack.enter_context(spool()), name, kind, table.rows)
                    for name, kind in table.columns.items()
                ]
                step = max(BLOCK, -(-table.rows // _BLOCKS))
                for first in range(0, table.rows, step):
                    last = min(first + step, table.rows)
                    for column, rows in zip(packed, table.read(first, last), strict=True):
                        column.add(rows.tobytes())
                for column in packed:
                    column.move(archive, file, step)


class _Packed:
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


def _deflate(plain: bytes) -> bytes:
    """``plain`` as blocks of a deflate stream that a reader can decompress alone."""
    packer = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS)
    return packer.compress(plain) + packer.flush(zlib.Z_FULL_FLUSH)


@dataclass
class Column:
    """An array of shape (rows,) in an .npz file; ``column[first:last]`` reads only those rows.

    Attributes:
        path, name: file and member.
        dtype, rows: of the array.
        step: rows a block; ``rows`` for a file of another writer, which is read as a whole.
        starts: where each block begins in the file, and where the last one ends, bytes.
    """

    path: Path
    name: str
    dtype: np.dtype[Any]
    rows: int
    step: int
    starts: tuple[int, ...]

    def __post_init__(self) -> None:
        self._held: tuple[int, NDArray[Any]] = (-1, np.empty(0, self.dtype))

    def __len__(self) -> int:
        return self.rows

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """The rows of a slice with step 1.

        Raises:
            OSError: the file is gone.
            UserError: the file is damaged.
        """
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
        if not self.starts:
            with np.load(self.path) as file:
                return np.asarray(file[self.name])
        with self.path.open("rb") as file:
            file.seek(self.starts[k])
            packed = file.read(self.starts[k + 1] - self.starts[k])
        rows = min(self.step, self.rows - k * self.step)
        unpacker = zlib.decompressobj(-zlib.MAX_WBITS)
        plain = unpacker.decompress(packed, rows * self.dtype.itemsize)
        return np.frombuffer(plain, self.dtype, rows)


def open_npz(path: Path) -> dict[str, Column]:
    """The columns of an .npz file, none of them read yet.

    Raises:
        OSError: it cannot be read.
        UserError: it is damaged.
    """
    try:
        return _open(path)
    except _DAMAGED as problem:
        raise UserError(f"{path} is damaged: {problem}") from None


def _open(path: Path) -> dict[str, Column]:
    found = {}
    with zipfile.ZipFile(path) as archive, path.open("rb") as file:
        for info in archive.infolist():
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                read = {
                    (1, 0): np.lib.format.read_array_header_1_0,
                    (2, 0): np.lib.format.read_array_header_2_0,
                }[version]
                (rows,), _, dtype = read(member)
            if rows * dtype.itemsize > _DENSEST * (info.compress_size + 1):
                raise ValueError(f"{info.filename} cannot hold {rows} rows")
            step, starts = max(1, rows), ()
            if field := _field(info.extra):
                file.seek(info.header_offset + 26)  # lengths of name and extra field
                begin = info.header_offset + 30 + sum(struct.unpack("<HH", file.read(4)))
                step, *relative = struct.unpack(f"<{len(field) // 8}Q", field)
                starts = tuple(begin + at for at in (*relative, info.compress_size))
            name = info.filename.removesuffix(".npy")
            found[name] = Column(path, name, dtype, rows, step, starts)
    return found


def _field(extra: bytes) -> bytes:
    """The content of our extra field; empty if there is none."""
    while len(extra) >= 4:
        number, size = struct.unpack_from("<HH", extra)
        if number == _FIELD:
            return extra[4 : 4 + size]
        extra = extra[4 + size :]
    return b""
