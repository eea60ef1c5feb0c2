"""Columns in an .npz file: compressed block by block, so that any rows can be read alone.

The file is what ``np.savez_compressed`` writes, and ``np.load`` reads it as any other. In addition
each block of rows is compressed by itself, and an extra field of the zip directory says where the
blocks begin. Writing and reading take the memory of a few blocks, however long the columns are.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_hil.errors import UserError
from gfm_hil.files import replacing

BLOCK = 1 << 16  # rows, at least
_BLOCKS = 4000  # at most: an extra field holds 64 KiB
# of 60 s of the paper's rig, 134 MB: level 1 leaves 47.1 MB, level 3 46.9, level 6 46.0 in 3.5
# times the time
_LEVEL = 1
_FIELD = 0x6667  # id of the extra field: rows a block, then where each block begins
_LAST = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS).flush()  # ends a deflate stream


@dataclass(frozen=True)
class Source:
    """A column to be written: its type, its length, and ``read(first, last)`` for its rows."""

    dtype: np.dtype[Any]
    rows: int
    read: Callable[[int, int], NDArray[Any]]

    @staticmethod
    def of(array: NDArray[Any]) -> Source:
        """An array of shape (rows,)."""
        return Source(array.dtype, len(array), lambda first, last: array[first:last])


def write_npz(path: Path, columns: Mapping[str, Source]) -> None:
    """Write ``path`` as a whole, one column after the other.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(path) as part, part.open("wb") as file, zipfile.ZipFile(file, "w") as archive:
        for name, column in columns.items():
            info = zipfile.ZipInfo(f"{name}.npy")
            size, crc, starts = 0, 0, []
            step = max(BLOCK, -(-column.rows // _BLOCKS))
            # zipfile copies what is compressed already as it is; then the member is declared to be
            # what it is, in its own header here and in the directory when the archive is closed
            with archive.open(info, "w", force_zip64=True) as member:
                at = 0
                for plain in _plain(column, step):
                    size, crc = size + len(plain), zlib.crc32(plain, crc)
                    at += member.write(_deflate(plain))
                    starts.append(at)
                member.write(_LAST)
            info.compress_type, info.file_size, info.CRC = zipfile.ZIP_DEFLATED, size, crc
            file.seek(info.header_offset)
            file.write(info.FileHeader(zip64=True))
            field = struct.pack(f"<{len(starts)}Q", step, *starts[:-1])  # the header is no block
            info.extra = struct.pack("<HH", _FIELD, len(field)) + field


def _plain(column: Source, step: int) -> Iterator[bytes]:
    """What np.load is to read: the header of an array, then its rows in blocks."""
    header = io.BytesIO()
    about = {"descr": column.dtype.str, "fortran_order": False, "shape": (column.rows,)}
    np.lib.format.write_array_header_1_0(header, about)
    yield header.getvalue()
    for first in range(0, column.rows, step):
        yield column.read(first, min(first + step, column.rows)).tobytes()


def _deflate(plain: bytes) -> bytes:
    """``plain`` as blocks of a deflate stream that depend on nothing before and end nothing."""
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
            except (zlib.error, ValueError, EOFError, zipfile.BadZipFile) as problem:
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
        OSError, ValueError, EOFError, zipfile.BadZipFile: it cannot be read.
    """
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


class Arrays(Mapping[str, NDArray[Any]]):
    """Columns as arrays, each read as a whole whenever it is asked for."""

    def __init__(self, columns: Mapping[str, Column]) -> None:
        self._columns = columns

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._columns[name][:]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __contains__(self, name: object) -> bool:
        return name in self._columns
