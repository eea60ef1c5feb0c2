"""The one exception for a law that must not reach the kernel."""

from __future__ import annotations


class LawError(ValueError):
    """A law, one of its elements or one of its parameters is not usable.

    Args:
        where: the faulty item, e.g. ``"phi_22"``, ``"parameter H"``, ``"law file x.toml"``.
        why: the value found and what is allowed.
    """

    def __init__(self, where: str, why: str) -> None:
        self.where, self.why = where, why
        super().__init__(printable(f"{where}: {why}"))


def printable(text: str) -> str:
    """The text in one line: line breaks and control characters, which TOML allows, are escaped."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
