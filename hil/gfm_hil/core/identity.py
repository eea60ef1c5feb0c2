"""Who gives a command, for the log of the run."""

import os
import pwd
from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Identity(BaseModel):
    """An operator. The command server's socket is in a folder of this user alone, so that only
    programs of this user can say who gives a command; each server reports what it knows of its
    peer."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    # what passes the command on: scope, modbus, xcp, command or python
    through: str = Field(max_length=20)
    # of the token (scope), of the local user (command, python), or ``timer`` if the Modbus server
    # itself reverts a set-point
    name: str | None = Field(None, max_length=100)
    peer: str | None = Field(None, max_length=100)  # address and port of the other end
    # subject of the client's TLS certificate
    certificate: str | None = Field(None, max_length=1000)
    # uid, pid: of a local process
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
