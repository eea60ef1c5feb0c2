"""How numbers, names and remarks look in C99, and the templates they go into.

A template holds keys, ``@KEY@``, and choices, each mark on a line of its own::

    /* @if NAME@ */
        a();
    /* @else@ */
        b();
    /* @end@ */

A choice is made when the C code is written; ``@elif NAME@`` is possible too.
"""

import re
import unicodedata
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

#: by its name, whether a choice holds
Choices = Mapping[str, bool]
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


def wrap_line(line: str, width: int = 100) -> list[str]:
    """A line of C; a long one goes on, indented, after an operator or a comma."""
    out, indent = [], line[: len(line) - len(line.lstrip())]
    while len(line) > width:
        for signs in ((" + ", " - ", " && ", " || ", " ? ", " : "), (", ",), (" * ",)):
            at = max(line.rfind(sign, len(indent) + 16, width - 2) for sign in signs)
            if at > 0:
                break
        if at < 0:
            break
        at += line.startswith(", ", at)
        out.append(line[:at])
        line = f"{indent}    {line[at:].lstrip()}"
    return [*out, line]


@cache
def template(name: str) -> str:
    """A file of the folder ``templates``."""
    return TEMPLATES.joinpath(name).read_text(encoding="utf-8")


def render(name: str, keys: Mapping[str, str], choices: Choices | None = None) -> str:
    """A template with its choices made and its keys replaced; errors as of those."""
    return fill_keys(choose_parts(template(name), choices or {}), keys)


def fill_keys(text: str, values: Mapping[str, str]) -> str:
    """The text with every ``@KEY@`` replaced. Raises KeyError: the text holds a key that ``values``
    does not."""
    return re.sub(r"@([\w.-]+)@", lambda found: values[found[1]], text)


_MARK = re.compile(r" */\* @(if|elif|else|end)(?: (\w+))?@ \*/\n")


def choose_parts(text: str, choices: Choices) -> str:
    """The text with its choices made. Raises KeyError: the text asks for a choice that ``choices``
    does not hold."""
    out: list[str] = []
    taken: list[bool | None] = []  # of the open choices; None once another part was taken
    for line in text.splitlines(keepends=True):
        mark = _MARK.fullmatch(line)
        if mark is None:
            if all(taken):
                out.append(line)
        elif mark[1] == "end":
            taken.pop()
        else:
            done = mark[1] != "if" and taken.pop() is not False
            taken.append(None if done else mark[1] == "else" or bool(choices[mark[2]]))
    return "".join(out)
