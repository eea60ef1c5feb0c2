"""The file of an ipc endpoint: checks that a process of our own user made it and listens there, and
that no other user can replace it."""

import os
import socket
import stat
from pathlib import Path

from gfm_hil.core import temporary as scratch
from gfm_hil.core.errors import UserError

SCHEME = "ipc://"


def path_of(endpoint: str) -> Path:
    """The path of the socket of an ipc endpoint."""
    return Path(endpoint.removeprefix(SCHEME))


def is_served(endpoint: str) -> bool:
    """Whether a process of our user listens at an ipc endpoint. Raises UserError: the folder, the
    file or the process belongs to another user, another user could replace the file or connect to
    it, or it is not a socket."""
    path = path_of(endpoint)
    where = f"link.endpoint = {endpoint!r}"
    try:
        folder = path.parent.stat()
        if not scratch.is_guarded(folder):
            raise UserError(
                f"{where}: other users can replace what is in {path.parent} (owner uid "
                f"{folder.st_uid}, mode {stat.S_IMODE(folder.st_mode):04o}); take a folder that "
                "only your user can write to"
            )
        found = path.lstat()
    except PermissionError:
        raise UserError(f"{where}: {path.parent} belongs to another user") from None
    except OSError:  # folder or file is missing; binding reports what is wrong
        return False
    if found.st_uid != os.geteuid():
        raise UserError(f"{where}: {path} belongs to another user (uid {found.st_uid})")
    if not stat.S_ISSOCK(found.st_mode):
        raise UserError(f"{where}: {path} is there and is no socket")
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:  # left by a killed run
            return False
    if found.st_mode & 0o022 and not scratch.is_private(folder):
        mode = stat.S_IMODE(found.st_mode)
        raise UserError(f"{where}: other users may connect to {path} (mode {mode:04o})")
    return True
