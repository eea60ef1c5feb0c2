"""Tables of one kind in TOML that are shipped under a name, or stand in a file of the user."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Generic, TypeVar

from pydantic import ValidationError

from gfm_runtime.errors import LawError, meant
from gfm_runtime.mistakes import lines
from gfm_runtime.toml_file import parse_toml, read_text

NONE = "none"
T = TypeVar("T")


@dataclass(frozen=True)
class Shipped(Generic[T]):
    """The tables of one kind."""

    what: str  #: they are, in messages
    folder: str  #: of ``gfm_runtime``
    model: Any  #: the type that they have
    validate: Callable[[Any], T]  #: a table as that type

    def names(self) -> tuple[str, ...]:
        """The names of the shipped files, and ``none``."""
        inside = files("gfm_runtime").joinpath(self.folder).iterdir()
        named = (p.name.removesuffix(".toml") for p in inside if p.name.endswith(".toml"))
        return (NONE, *sorted(named))

    def named(self, name: str) -> T | None:
        """The table of a shipped name, or of a path that ends in ``.toml``; None for ``none``.
        Raises LawError: an unknown name, or every mistake of the file."""
        if name == NONE:
            return None
        where, content = f"{self.what} {name}", dict[str, Any]()
        try:
            if name.endswith(".toml"):
                text = read_text(name)
            elif name in self.names():
                file = files("gfm_runtime").joinpath(self.folder, f"{name}.toml")
                text = file.read_text(encoding="utf-8")
            else:
                known = list(self.names())
                raise ValueError(f"unknown; use a .toml file or one of {known}{meant(name, known)}")
            content = parse_toml(text)
            return self.validate(content)
        except ValidationError as problem:
            raise LawError(where, *lines(problem, self.model, content=content)) from None
        except ValueError as problem:
            raise LawError(where, str(problem)) from None
