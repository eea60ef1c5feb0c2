"""Links carry frames between the two processes: one folder per link, one interface."""

from gfm_hil.links.base import Link, LinkKind, LinkOptions
from gfm_hil.links.port import Port, port_function
from gfm_hil.links.registry import link_kind, link_names, open_link

__all__ = [
    "Link",
    "LinkKind",
    "LinkOptions",
    "Port",
    "link_kind",
    "link_names",
    "open_link",
    "port_function",
]
