"""The catalogue: every law that ships, one TOML file each in ``gfm_runtime/laws``.

``laws/tuned`` holds the same laws with the gains that the law comparison found for the paper's
converter, ``laws/grid`` those for grid codes, with a declared droop of 5 %, ``laws/industry`` the
models that grid operators know by name, for the converter of their own, and a grid-following law.
They load by name like the others, but ``law_names`` does not list them.
"""

import contextlib
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path

from gfm_runtime.counts import named_counts
from gfm_runtime.errors import LawError, meant
from gfm_runtime.law import BuiltLaw
from gfm_runtime.lawfile import LawFile, Schedule, build_law, parse_law, read_law_file, shipped_law


@dataclass(frozen=True)
class LawSet:
    """The laws of one name: a single law, or the stages of a gain-scheduled one."""

    name: str  #: what results call it
    #: one law, or one for each stage in the order of `Schedule.ends`
    laws: tuple[BuiltLaw, ...]
    schedule: Schedule | None = None  #: None, or the limits of the stages
    #: the inner stage that replaces the law file's own, by name or path; None: its own
    inner: str | None = None
    counts: str | None = None  #: likewise, measurement and modulation
    asked: str = ""  #: the name or path by which it is asked for; its name if empty

    @property
    def first(self) -> BuiltLaw:
        """The law that is in force at the start."""
        return self.laws[self.schedule.start if self.schedule else 0]


def law_titles(names: Iterable[str]) -> dict[str, str]:
    """What results call the laws of catalogue names and paths: the name that a file gives its law.

    Of several laws with one name, those from files have the name of the file too. A file that
    cannot be read any more counts as one that calls its law as itself.
    """
    laws = dict.fromkeys(names)
    titles = {name: name for name in laws if not name.endswith(".toml")}
    for path in (name for name in laws if name not in titles):
        try:
            own = law_file(path).name
        except LawError:
            own = Path(path).stem
        more = Path(path).name
        tries = [own, f"{own} ({more})"]
        tries += [f"{own} ({more}, {k})" for k in range(2, len(laws) + 1)]
        titles[path] = next(title for title in tries if title not in titles.values())
    return {name: titles[name] for name in laws}


@cache
def law_names() -> tuple[str, ...]:
    """Names of all laws that ship except the tuned ones, in natural order."""
    return _names("")


@cache
def tuned_names() -> tuple[str, ...]:
    """Names of the laws with tuned gains, e.g. ``vsg-5-tuned``, in natural order."""
    return _names("tuned")


@cache
def grid_names() -> tuple[str, ...]:
    """Names of the laws for grid codes, with a droop of 5 %, e.g. ``vsg-7-grid``, in natural
    order."""
    return _names("grid")


@cache
def industry_names() -> tuple[str, ...]:
    """Names of the laws that are models of the industry, e.g. ``regfm-a1``."""
    return _names("industry")


def _names(group: str) -> tuple[str, ...]:
    folder = files("gfm_runtime").joinpath("laws", group)
    found = [p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")]

    def natural(name: str) -> list[int | str]:  # vsg-2 before vsg-10
        return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]

    return tuple(sorted(found, key=natural))


@cache
def _shipped(name: str) -> LawFile | None:
    text = shipped_law(name)
    return None if text is None else parse_law(text, f"law {name}")


def law_file(name: str) -> LawFile:
    """The parsed law file of a catalogue name, or of a path that ends in ``.toml``.

    Raises:
        LawError: an unknown name (the known ones are listed), or a file that is not a law.
    """
    if name.endswith(".toml"):
        return read_law_file(name)
    if (shipped := _shipped(name)) is not None:
        return shipped
    close = meant(name, [*law_names(), *tuned_names(), *grid_names(), *industry_names()])
    with contextlib.suppress(OSError, ValueError):  # of what can be no path
        if Path(f"{name}.toml").is_file():
            close = f"; did you mean '{name}.toml'?"
    known = f"one of {list(law_names())}, or of gfmhil laws --tuned, --grid, --industry"
    raise LawError(f"law {name!r}", f"unknown{close or ';'} use a .toml file or {known}")


def load_law(
    name: str, inner: str | None = None, counts: str | None = None, **changed: float
) -> LawSet:
    """A law by catalogue name or path, with parameters changed by name if wanted.

    Args:
        inner: an inner stage in place of the file's own, see ``LawFile.behind``.
        counts: measurement and modulation in place of the file's own, likewise.
        changed: values of parameters.

    Raises:
        LawError: as ``law_file`` and ``build_law``.
    """
    file = law_file(name).behind(inner)
    stages = file.schedule.in_order if file.schedule else []
    sets = [{**stage.parameters, **changed} for stage in stages] or [changed]
    try:
        laws = tuple(build_law(file, parameters) for parameters in sets)
    except LawError as problem:
        raise problem.within(f"law {'file ' * name.endswith('.toml')}{name}") from None
    if counts is not None:
        laws = tuple(replace(law, counts=named_counts(counts)) for law in laws)
    return LawSet(file.name, laws, file.schedule, inner, counts, name)


def get_law(name: str, **changed: float) -> BuiltLaw:
    """A single law; of a gain-scheduled one, the stage in force at the start."""
    return load_law(name, None, None, **changed).first
