"""Who gives a command, for the log of the run."""

import os
import pwd
from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Identity(BaseModel):
    """An operator. The command server's socket is in a folder of this user alone, so that only
    programs of this user can say who gives a command; each server reports what it knows of its
    peer.

    Attributes:
        through: what passes the command on: scope, modbus, xcp, command or python.
        name: of the token (scope), of the local user (command, python), or ``timer`` if the Modbus
            server itself reverts a set-point.
        peer: address and port of the other end.
        certificate: subject of the client's TLS certificate.
        uid, pid: of a local process.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    through: str = Field(max_length=20)
    name: str | None = Field(None, max_length=100)
    peer: str | None = Field(None, max_length=100)
    certificate: str | None = Field(None, max_length=1000)
    uid: int | None = Field(None, ge=0, lt=2**32)
    pid: int | None = Field(None, ge=0, lt=2**32)

    def plain(self) -> dict[str, Any]:
        """The known fields as plain data."""
        return self.model_dump(exclude_none=True)


def local(through: str) -> Identity:
    """The identity of this process and its user."""
    uid = os.getuid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:  # in a container a user may have no name
        name = None
    return Identity(through=through, name=name, uid=uid, pid=os.getpid())


def address(peer: Any) -> str:
    """Address and port as one text, from the result of ``getpeername``."""
    if not isinstance(peer, tuple):
        return str(peer)
    host, port = peer[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
