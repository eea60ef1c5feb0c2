"""Reading a user's TOML file: every fault of the file gives a message of one line.

Tables and arrays of the result are nested at most ``MAX_DEPTH`` deep, so that code
may walk through them by recursion.
"""

import tomllib
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, PlainValidator
from pydantic_core import PydanticCustomError

from gfm_runtime.regular import read_regular

MAX_BYTES = 4 * 2**20  # some ten thousand events
MAX_DEPTH = 32


class TomlTable(BaseModel):
    """Base of the tables of a law file: unknown keys and wrong types are mistakes."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def _number(value: Any) -> float | str:
    if isinstance(value, str):
        return value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):
            return float(value)
    raise PydanticCustomError("number", "must be a number or an expression over the parameters")


def _signed(zero: bool) -> PlainValidator:
    """A validator of numbers > 0, or >= 0 if ``zero``, and of expressions."""
    name, must = ("not_negative", "must be >= 0") if zero else ("positive", "must be > 0")

    def validated(value: Any) -> float | str:
        number = _number(value)
        if not isinstance(number, str) and not (number >= 0.0 if zero else number > 0.0):
            raise PydanticCustomError(name, must)
        return number

    return PlainValidator(validated, float | str)


# A number or an expression over the law's parameters: a float once the expressions are
# ``evaluated``. One validator, because a union would give two errors a mistake.
if TYPE_CHECKING:
    Number = float
    NumberOrName = float | str
    Positive = float
    NotNegative = float
else:
    Number = NumberOrName = Annotated[float | str, PlainValidator(_number, float | str)]
    Positive = Annotated[float | str, _signed(zero=False)]
    NotNegative = Annotated[float | str, _signed(zero=True)]


def read_toml(path: str | Path, links: bool = True) -> dict[str, Any]:
    """The content of a TOML file; ``links``: it may be a link. Raises ValueError: one line: as
    ``read_text`` or ``parse_toml``."""
    return parse_toml(read_text(path, links))


def read_text(path: str | Path, links: bool = True) -> str:
    """The text of a file, with or without a byte order mark; ``links``: it may be a link. Raises
    ValueError: one line: the file cannot be opened, is not regular (a pipe or a device may have no
    end), is larger than ``MAX_BYTES`` or is not UTF-8."""
    try:
        data = read_regular(path, MAX_BYTES, links)
    except OSError as problem:
        raise ValueError(f"cannot be read: {problem.strerror}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        line = data[: problem.start].count(b"\n") + 1
        raise ValueError(f"cannot be read: line {line} is not UTF-8") from None


def parse_toml(text: str) -> dict[str, Any]:
    """The content of a TOML text. Raises ValueError: one line: it is not TOML, or is nested too
    deeply."""
    too_deep = f"not usable: tables and arrays are nested more than {MAX_DEPTH} deep"
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise ValueError(too_deep) from None
    except ValueError as problem:  # TOMLDecodeError, or an integer of thousands of digits
        raise ValueError(f"not TOML: {problem}") from None
    level: list[Any] = [content]
    for _ in range(MAX_DEPTH):
        level = [
            below
            for value in level
            if isinstance(value, (dict, list))
            for below in (value.values() if isinstance(value, dict) else value)
        ]
    if level:
        raise ValueError(too_deep)
    return content
