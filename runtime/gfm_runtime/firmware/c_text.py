"""How numbers, names and remarks look in C99, and the templates they go into."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

TEMPLATES = files("gfm_runtime.firmware").joinpath("templates")


def literal(value: Any, real: np.dtype[Any]) -> str:
    """A hexadecimal literal with exactly the value of a number in that precision."""
    rounded = real.type(value)
    text = re.sub(r"\.?0*p", "p", float(rounded).hex(), count=1)
    return text + ("f" if real == np.float32 else "")


def literals(values: Iterable[Any], real: np.dtype[Any]) -> str:
    """Literals between commas."""
    return ", ".join(literal(v, real) for v in values)


def identifier(name: str) -> str:
    """A law's name as part of a C identifier, e.g. ``vsg_1`` or ``mimo_gfm_scheduled_0``."""
    return re.sub(r"[^a-z0-9]+", "_", plain(name).lower()).strip("_")


def plain(text: str) -> str:
    """A text in one line of ASCII that can stand in a comment."""
    ascii_text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    one_line = " ".join(ascii_text.split())
    return one_line.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").rstrip("\\")


@cache
def template(name: str) -> str:
    """A file of the folder ``templates``."""
    return TEMPLATES.joinpath(name).read_text(encoding="utf-8")


def filled(text: str, values: Mapping[str, str]) -> str:
    """The text with every ``@KEY@`` replaced.

    Raises:
        KeyError: the text holds a key that ``values`` does not.
    """
    return re.sub(r"@([\w.-]+)@", lambda found: values[found[1]], text)
