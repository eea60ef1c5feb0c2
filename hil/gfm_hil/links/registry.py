"""Links by name."""

from __future__ import annotations

from gfm_hil.errors import UserError
from gfm_hil.links.base import Link, LinkFactory, Side
from gfm_hil.links.zeromq import ZmqLink

LINKS: dict[str, LinkFactory] = {"zmq": ZmqLink}


def open_link(name: str, side: Side, endpoint: str) -> Link:
    """Open one end of the link of that name.

    Raises:
        UserError: an unknown name, or what the link's factory raises.
    """
    if name not in LINKS:
        raise UserError(f"link.type = {name!r}: must be one of {sorted(LINKS)}")
    return LINKS[name](side, endpoint)
