"""A table for the terminal, a page and Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as RichTable

_ANY = 100_000  # characters; more than any table takes
#: what a cell means, and how the terminal shows it; a page has classes of these names
STYLES = {"good": "green", "warn": "yellow", "bad": "red", "head": "bold", "dim": "dim"}


class Cell(NamedTuple):
    """A cell with more than a text."""

    text: Any  # as ``shown`` writes values
    style: str = ""  # a key of ``STYLES``, or ""
    link: str = ""  # address that a page links it to, or ""
    classes: str = ""  # of HTML, further ones


def shown(value: Any) -> str:
    """A value as people read it; – for one that is unknown or that there is not."""
    match value:
        case Cell():
            return shown(value.text)
        case None:
            return "–"
        case float():
            return f"{value:.4g}" if abs(value) < 10 else f"{value:.5g}"
        case list():
            return ", ".join(shown(v) for v in value) or "–"
    return str(value)


@dataclass(frozen=True)
class Table:
    """Rows under heads, which name the units."""

    heads: Sequence[str]  # of the columns; none for a table without a line of heads
    rows: Sequence[Sequence[Any]]  # values, as ``shown`` writes them, or cells
    title: str = ""  # title, caption: above and below it
    caption: str = ""
    # how many columns from the left are text; the others are numbers, at the right. None: all are
    # text
    text: int | None = 1
    fold: int | None = None  # which column of text is broken first where the terminal is narrow

    def is_text(self, column: int) -> bool:
        """Whether a column is text."""
        return self.text is None or column < self.text

    def cells(self) -> Iterator[list[Cell]]:
        """The rows as cells."""
        return ([x if isinstance(x, Cell) else Cell(x) for x in row] for row in self.rows)

    def markdown(self) -> str:
        """As Markdown; a cell's text must not hold a bar."""
        lines = [f"| {' | '.join(map(shown, cells))} |" for cells in (self.heads, *self.rows)]
        return "\n".join([lines[0], f"|{'---|' * len(self.heads)}", *lines[1:]])

    def __rich__(self) -> RichTable:
        """As a table of rich, without lines, which a console prints."""
        from rich.table import Column
        from rich.table import Table as Drawn
        from rich.text import Text

        width = len(self.heads) or max(map(len, self.rows), default=0)
        columns = [
            Column(
                Text(self.heads[k] if self.heads else ""),
                justify="left" if self.is_text(k) else "right",
                no_wrap=self._is_whole(k),
                overflow="fold" if k == self.fold else "ellipsis",
            )
            for k in range(width)
        ]
        table = Drawn(
            *columns,
            title=Text(self.title) if self.title else None,
            caption=Text(self.caption) if self.caption else None,
            title_justify="left",
            caption_justify="left",
            box=None,
            pad_edge=False,
            show_header=bool(self.heads),
        )
        for row in self.cells():
            table.add_row(*(Text(shown(x), STYLES.get(x.style, "")) for x in row))
        return table

    def _is_whole(self, column: int) -> bool:
        """A column that no terminal breaks: the first, and numbers under heads of one word."""
        if column == self.fold:
            return False
        return column == 0 or (not self.is_text(column) and " " not in self.heads[column])

    def fitting(self, console: Console) -> Iterator[Table]:
        """As tables of as many columns as the console shows without breaking any, at least one
        beside the first."""
        free, left = console.options.update(max_width=_ANY), [*range(1, len(self.heads))]
        while left:
            count = len(left)
            while (
                count > 1
                and console.measure(self._of(left[:count]), options=free).maximum > console.width
            ):
                count -= 1
            yield self._of(left[:count])
            left = left[count:]

    def _of(self, columns: Sequence[int]) -> Table:
        """The first column and some others."""
        some = [0, *columns]
        rows = [[row[k] for k in some if k < len(row)] for row in self.rows]
        return replace(self, heads=[self.heads[k] for k in some], rows=rows)
