"""The table ``link.options`` of a ZeroMQ link."""

from __future__ import annotations

import ipaddress
import socket
from pathlib import Path

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


_IFF_LOOPBACK = 0x8  # of linux/if.h


def refuse_open(endpoint: str | None, options: ZmqOptions) -> None:
    """Check that frames leave this machine only encrypted or with ``plain = true``, and that file
    permissions control who may connect on this machine. Raises ValueError: the check fails."""
    if endpoint is None:
        return
    if endpoint.startswith("ipc://@"):
        raise ValueError(
            f"endpoint = {endpoint!r}: an abstract socket is no file, so that any user of this "
            "machine could connect; give a path, as ipc:///tmp/link"
        )
    if options.curve is None and not options.plain and beyond_loopback(endpoint):
        raise ValueError(
            f"endpoint = {endpoint!r}: goes beyond this machine, unencrypted: set "
            "link.options.curve to a folder of keys (gfmhil keys makes one), or "
            "link.options.plain = true if that is meant"
        )


def beyond_loopback(endpoint: str) -> bool:
    """False for ipc, and for tcp if the host is only this machine's loopback.

    A host that does not resolve, or ``*``, counts as beyond.
    """
    if not endpoint.startswith("tcp://"):
        return False
    host = endpoint.removeprefix("tcp://").rpartition(":")[0].strip("[]")
    return not (_interface_is_loopback(host) or _addresses_are_loopback(host))


def _interface_is_loopback(name: str) -> bool:
    """``tcp://lo:5555``: libzmq also accepts interface names."""
    try:
        flags = (Path("/sys/class/net") / name / "flags").read_text("ascii")
    except (OSError, ValueError):
        return False
    return bool(int(flags, 16) & _IFF_LOOPBACK)


def _addresses_are_loopback(host: str) -> bool:
    try:
        found = {str(info[4][0]) for info in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):
        return False
    return bool(found) and all(ipaddress.ip_address(a).is_loopback for a in found)
