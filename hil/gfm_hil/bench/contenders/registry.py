"""Which contenders are measured for some links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from gfm_hil.bench.c_code import NoCompiler, compile_c
from gfm_hil.bench.contenders.base import Contender

#: files of this folder, in the order of the tables. Each has a function ``contenders(links,
#: place)`` that yields what it adds to these links; place is a folder in memory with a short path.
FILES = ("udp", "shm", "iceoryx2", "zmq")


def contenders_of(links: Sequence[str], place: Path) -> tuple[list[Contender], list[str]]:
    """The contenders, each after its limit, and remarks: without a C compiler there are no limits.

    Args:
        links: names of links.
        place: an empty folder in memory with a short path.
    """
    files = [import_module(f"{__package__}.{name}") for name in FILES]
    every: list[Contender] = [one for file in files for one in file.contenders(links, place)]
    try:
        libraries = {
            source: compile_c(source, place, f"{source.stem}_pingpong")
            for source in dict.fromkeys(c.source for c in every if c.source is not None)
        }
    except NoCompiler as problem:
        without = [replace(c, limit="") for c in every if c.source is None]
        return without, [f"{problem}: no limits in C, no ratios"]
    return [replace(c, library=libraries[c.source]) if c.source else c for c in every], []
