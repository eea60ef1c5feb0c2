"""Links: how frames get from one process to the other. One folder a link, one interface."""

from gfm_hil.links.base import Link, LinkFactory
from gfm_hil.links.registry import open_link

__all__ = ["Link", "LinkFactory", "open_link"]
