"""The table ``link.options`` of a ZeroMQ link."""

from __future__ import annotations

from pydantic import Field, model_validator

from gfm_hil.links.base import LinkOptions


class ZmqOptions(LinkOptions):
    """Options of either side."""

    portable: bool = Field(
        False, description="leave the frames to pyzmq, where calling libzmq itself is unwanted"
    )
    curve: str | None = Field(
        None,
        min_length=1,
        description="folder with the keys of gfmhil keys: encrypt, know the peer",
    )
    plain: bool = Field(False, description="go beyond this machine without encryption")

    @model_validator(mode="after")
    def _one_of_both(self) -> ZmqOptions:
        if self.plain and self.curve is not None:
            raise ValueError(f"plain = true and curve = {self.curve!r}: only one of both")
        return self
