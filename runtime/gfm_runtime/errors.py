"""The one exception for a law that must not reach the kernel, and words that messages share."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Iterator, Sequence

_MANY = 6  # names of a list that hides what stands behind it
_PLACES = 3  # of one mistake that a message names


class LawError(ValueError):
    """A law, one of its elements or one of its parameters is not usable.

    Args:
        where: the faulty item, e.g. ``"phi_22"``, ``"parameter H"``, ``"law file x.toml"``.
        why: the value found and what is allowed; one text for each mistake.
        lines: what to print, one line for each mistake; ``where`` and ``why`` if empty.
    """

    def __init__(self, where: str, *why: str, lines: Sequence[str] = ()) -> None:
        self.where, self.why = where, "; ".join(why)
        self.lines = [*lines] or [printable(f"{where}: {text}") for text in why]
        super().__init__("\n".join(self.lines))

    def within(self, where: str) -> LawError:
        """The same mistakes, each line of which names ``where`` first."""
        return LawError(
            self.where, self.why, lines=[printable(f"{where}: {line}") for line in self.lines]
        )


class Mistakes:
    """Collects the mistakes of a law, so that a person is told all of them at once."""

    def __init__(self) -> None:
        self._found: list[LawError] = []

    @contextlib.contextmanager
    def noting(self) -> Iterator[None]:
        """Note a LawError of the block and go on after it."""
        try:
            yield
        except LawError as problem:
            self._found.append(problem)

    def check(self) -> None:
        """Raise LawError with every mistake noted, if there are any."""
        if self._found:
            same: dict[str, list[LawError]] = {}
            for problem in self._found:  # one wrong word may be used in many places
                bare = problem.lines == [printable(f"{problem.where}: {problem.why}")]
                same.setdefault(problem.why if bare else str(problem), []).append(problem)
            lines = []
            for why, problems in same.items():
                places = [problem.where for problem in problems]
                where = ", ".join(places[:_PLACES])
                where += f" and {len(places) - _PLACES} more" if len(places) > _PLACES else ""
                several = [printable(f"{where}: {why}")]
                lines += several if len(problems) > 1 else problems[0].lines
            raise LawError(self._found[0].where, *same, lines=lines)


def closest(name: object, known: Iterable[str]) -> str | None:
    """The known name that is most like an unknown one, if any."""
    names = {str(other).lower(): other for other in known}
    close = difflib.get_close_matches(str(name).lower(), names, n=1)
    return names[close[0]] if close else None


def meant(name: object, known: Iterable[str]) -> str:
    """The end of a message about an unknown name: the known name that is most like it, if any."""
    close = closest(name, known)
    return f"; did you mean {close!r}?" if close else ""


def allowed(
    name: object, known: Iterable[str], words: str = "must be one of", more: str = ""
) -> str:
    """What an unknown name must be; before a long list the known name that is most like it.

    Args:
        name: the unknown one.
        known: all that are known, in the order of the list.
        words, more: before and after the list.
    """
    listed = list(known)
    text, close = f"{words} {listed}{more}", meant(name, listed)
    return f"{close.removeprefix('; ')} {text}" if close and len(listed) > _MANY else text + close


def printable(text: str) -> str:
    """The text in one line: line breaks and control characters, which TOML allows, are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
