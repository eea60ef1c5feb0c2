"""The table ``link.options`` of a ZeroMQ link."""

from __future__ import annotations

from pydantic import Field

from gfm_hil.links.base import LinkOptions


class ZmqOptions(LinkOptions):
    """Options of either side."""

    portable: bool = Field(
        False, description="leave the frames to pyzmq, where calling libzmq itself is unwanted"
    )
