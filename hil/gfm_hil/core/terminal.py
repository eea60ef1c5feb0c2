"""Tables: on a terminal of any width, in a pipe or a file, and in Markdown."""

import os
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console

_ANY = 100_000  # columns; more than any table takes


class _Pipe(Console):
    """A console that is no terminal: rows of a table end where their text ends."""

    def print(self, *objects: Any, **options: Any) -> None:
        """As ``Console.print``."""
        with self.capture() as printed:
            super().print(*objects, **options)
        self.file.write("\n".join(line.rstrip(" ") for line in printed.get().split("\n")))


def terminal(**options: Any) -> Console:
    """A console with rich's ``options``, which wraps, cuts and fills up nothing where it is no
    terminal.

    As everywhere, the variable COLUMNS says another width.
    """
    console = Console(**options)
    if console.is_terminal:
        return console
    console = _Pipe(**options)
    if "COLUMNS" not in os.environ:
        console.width = _ANY
    return console


def markdown(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; a cell's text must not hold a bar."""
    lines = [f"| {' | '.join(cells)} |" for cells in (heads, *rows)]
    return "\n".join([lines[0], f"|{'---|' * len(heads)}", *lines[1:]])
