"""The link over a pseudo terminal, and its limit: the same bytes on one in C."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from gfm_hil.bench.contenders import Contender, fresh_endpoint, limit, of_link
from gfm_hil.bench.pingpong import Messages, PingPong, in_c
from gfm_hil.core.roles import Role
from gfm_hil.links import open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.serial.link import SerialLink

LIMIT = "C serial"


def contenders(links: Sequence[str], folder: Path) -> Iterator[Contender]:
    if "serial" in links:
        yield limit(LIMIT, __file__, fresh_endpoint("serial", folder / "c"), _open, LONGEST)
        yield of_link("serial", "serial", fresh_endpoint("serial", folder), LIMIT)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    keep = ExitStack()
    end = open_link("serial", role, c.endpoint)
    keep.callback(end.close)
    assert isinstance(end, SerialLink)
    return in_c(c.library, [end.fileno()], own.shape[1], keep)
