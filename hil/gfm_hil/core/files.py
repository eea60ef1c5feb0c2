"""Files of a run folder: read with limits, written whole or not at all.

A folder may come from anybody: what lies in place of a file may be a link, a pipe, a device, or
larger than memory. ``open_file``, ``read_file`` and ``read_json`` are the only ways in.
"""

import contextlib
import errno
import io
import os
import secrets
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import from_json

from gfm_hil.core.errors import UserError, lines, naming
from gfm_runtime.errors import printable
from gfm_runtime.regular import open_regular, read_regular

SMALL = 1 << 20  # bytes: more than any file that does not grow with the run has
_MOST_VALUES = 1 << 20  # of a JSON text: each takes up to some hundred bytes of memory
_PREFIX = ".part-"
_ENTRY = b"PK\x01\x02"  # begins each entry of a zip file's directory
_LONGEST = 1 << 17  # bytes of an entry, at most: a name and an extra field of 64 KiB each


def check_empty(folder: Path) -> None:
    """Raise UserError if a folder to write to holds something already, or is none."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        what = "is not empty" if folder.is_dir() else "is no folder"
        raise UserError(f"{folder}: {what}; choose another folder, or delete it")


def open_file(path: Path, most: int | None = None) -> io.BufferedReader:
    """Open a file of a run folder for reading: regular, no link, at most so many bytes. Raises
    FileNotFoundError: it is not there; UserError: it is something else, or too large."""
    with _refused(path):
        return open_regular(path, most, links=False)


def read_file(path: Path, most: int = SMALL) -> bytes:
    """The content of a file of a run folder; raises as ``open_file``."""
    with _refused(path):
        return read_regular(path, most, links=False)


def lines_of(path: str | Path) -> list[str]:
    """The lines of a text of another program, whose bytes that are no UTF-8 are replaced. Raises
    UserError: it is not there, or as ``open_file``."""
    try:
        return read_file(Path(path)).decode("utf-8", "replace").splitlines()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None


@contextlib.contextmanager
def _refused(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as problem:
        raise UserError(f"{path}: {problem.strerror}") from None


def read_json(path: Path, model: type[BaseModel], most: int = SMALL) -> dict[str, Any]:
    """The content of a JSON file of a run folder. Raises FileNotFoundError: it is not there. Raises
    UserError: one line: as ``open_file``, or it is no JSON or not what it must be.

    Args:
        path: of the file.
        model: what it must be.
        most: how many bytes it may have.
    """
    data = read_file(path, most)
    check_values(path, data)
    try:
        content = from_json(data)
        model.model_validate(content)
    except ValidationError as problem:
        raise UserError(f"{path}: {lines(problem, model)[0]}") from None
    except ValueError as problem:
        raise UserError(printable(f"{path}: is not JSON: {problem}")) from None
    return dict(content)


def check_values(path: Path, data: bytes) -> None:
    """See that a JSON text takes a limited memory when it is parsed. Raises UserError: it may hold
    too many values."""
    if sum(data.count(sign) for sign in (b",", b"[", b"{")) > _MOST_VALUES:
        raise UserError(f"{path}: holds more than {_MOST_VALUES} values")


class Archive(io.BufferedReader):
    """An open zip file whose directory has a limited length; to be given to ``zipfile``.

    Args:
        file: opened; it shares its place in the file with this one, which closes it.
        members: how many it may have.
    """

    def __init__(self, file: io.BufferedReader, members: int) -> None:
        super().__init__(file.raw)
        self._end = os.fstat(self.fileno()).st_size
        self._members = members

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; ``zipfile`` reads the directory at once. Raises BadZipFile: the directory
        is too long."""
        most = self._members * _LONGEST
        left = min(most, self._end - self.tell()) + 1  # a read of more would first take the memory
        data = super().read(min(left, size) if size is not None and size >= 0 else left)
        if len(data) > most or data.count(_ENTRY) > self._members:
            raise zipfile.BadZipFile(f"its directory has more than {self._members} members")
        return data


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; afterwards rename it to ``path``.

    The data is on disk before the rename is, so that a power failure leaves either the old file or
    the new one. If the block raises, ``path`` stays as it was. The file is new and its name cannot
    be told in advance, so that nobody can put a link in its place; if ``path`` is a link, the file
    replaces the link. Raises OSError: the file cannot be written, or ``path`` is a device or a
    pipe, which the rename would destroy; it names ``path``, not the path beside it.
    """
    other = path.exists() and not (path.is_file() or path.is_dir())
    if other or path.parent.resolve() == Path("/dev"):  # whose links lead to files, too
        raise OSError(errno.EINVAL, "is a device or a pipe; give the name of a file", str(path))
    part = path.with_name(f"{_PREFIX}{secrets.token_hex(8)}-{path.name}")
    try:
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666))
        yield part
        with part.open("rb") as file:
            os.fsync(file.fileno())
        part.replace(path)
    except OSError as problem:
        if problem.filename != str(part):
            raise
        raise OSError(problem.errno, problem.strerror, str(path)) from None
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, see ``replacing``."""
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def write_or_print(path: Path | None, text: str) -> None:
    """Write a text file, see ``write_text``, or print the text if it has no path."""
    if path is None:
        print(text, end="")
    else:
        write_text(path, text)


def write_new(path: Path, text: str, overwrite: bool = False) -> Path:
    """Write a text file; returns its path. Raises UserError: it is there already and not to
    ``overwrite``, or cannot be written."""
    if path.exists() and not overwrite:
        raise UserError(f"{path}: is there already; choose another name, or delete it")
    with naming(path):
        write_text(path, text)
    return path


def sync_folder(folder: Path) -> None:
    """Wait until the names in ``folder`` are on disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unfinished(folder: Path) -> list[Path]:
    """Files in ``folder`` that a killed process was writing."""
    return sorted(folder.glob(f"{_PREFIX}*"))
