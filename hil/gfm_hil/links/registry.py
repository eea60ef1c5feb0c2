"""Links by name: ours, and those that other packages register.

A package adds a link by an entry point of the group ``gfmhil.links`` that has the link's name and
loads a ``LinkKind``.
"""

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links.base import Link, LinkKind
from gfm_runtime.signals import PLAIN

GROUP = "gfmhil.links"

_OURS = {
    "can": "gfm_hil.links.can",
    "serial": "gfm_hil.links.serial",
    "shm": "gfm_hil.links.shm",
    "zmq": "gfm_hil.links.zeromq",
}


def link_names() -> list[str]:
    """Names of all available links."""
    return sorted({*_OURS, *(point.name for point in entry_points(group=GROUP))})


@cache
def link_kind(name: str) -> LinkKind:
    """The link of that name. Raises ValueError: there is none, or a package's link cannot be
    loaded."""
    if name in _OURS:
        return import_module(_OURS[name]).KIND
    for point in entry_points(group=GROUP, name=name):
        try:
            kind = point.load()
        except Exception as problem:  # a foreign module may raise anything
            raise ValueError(f"link {name!r}: {point.value} cannot be loaded: {problem}") from None
        if not isinstance(kind, LinkKind):
            raise ValueError(f"link {name!r}: {point.value} is not a LinkKind")
        return kind
    raise ValueError(f"link.type = {name!r}: must be one of {link_names()}")


def open_link(
    name: str,
    role: Role,
    endpoint: str,
    options: dict[str, Any] | None = None,
    signal_set: int = PLAIN,
) -> Link:
    """Open one end of the link of that name, for a run with that signal set. Raises UserError: the
    name, the endpoint or the options are wrong, or the link cannot be opened."""
    try:
        kind = link_kind(name)
        checked = kind.checked(endpoint, options or {}, signal_set)
    except ValueError as problem:
        raise UserError(f"link: {problem}") from None
    return kind.open(role, endpoint, checked)
