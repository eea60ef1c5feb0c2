"""CURVE: keys for both sides, encrypted and authenticated frames, and access for one plant only.

A folder of keys holds ``<role>.key``, the public key, and ``<role>.key_secret`` in pyzmq's format.
A side needs its own secret key and the other side's public key.
"""

import os
import struct
from pathlib import Path

import zmq
import zmq.auth
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils import z85

from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.roles import OTHER, ROLES, Role

_KEY_BYTES = 32
_DOMAIN = "gfmhil"


def key_files(folder: Path) -> list[Path]:
    """All files of a folder of keys."""
    return [folder / f"{role}.{kind}" for role in ROLES for kind in ("key", "key_secret")]


def write_keys(folder: Path, force: bool = False) -> list[Path]:
    """Write a new key pair per side, readable by the user alone. Raises UserError: a key exists and
    ``force`` is not set, or it cannot be written."""
    _need_curve()
    files = key_files(folder)
    for file in files:
        if file.exists() and not force:
            raise UserError(f"{file}: is there already; --force replaces all keys of the folder")
    before = os.umask(0o077)
    try:
        with naming(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for file in files:
                file.unlink(missing_ok=True)  # an existing file would keep its mode
            for role in ROLES:
                zmq.auth.create_certificates(folder, role)
    finally:
        os.umask(before)
    return files


class Curve:
    """Encryption of one side's socket; at the controller also access control. Raises UserError: a
    key is missing or invalid.

    Args:
        socket: not yet bound or connected.
        role, folder: whose keys, and where they are.
    """

    def __init__(self, socket: zmq.Socket[bytes], role: Role, folder: Path) -> None:
        _need_curve()
        public, secret = _key(folder / f"{role}.key_secret")
        self._peer, _ = _key(folder / f"{OTHER[role]}.key")
        self._door: ThreadAuthenticator | None = None
        socket.curve_publickey, socket.curve_secretkey = public, secret
        if role == "controller":
            socket.curve_server = True
            # without an authenticator libzmq accepts every peer that knows our public key, unless
            # authentication is enforced, which requires a domain
            socket.zap_domain = _DOMAIN.encode()
            socket.set(zmq.ZAP_ENFORCE_DOMAIN, 1)
            self._door = ThreadAuthenticator(socket.context)
            self._door.start()
            self._door.configure_curve_callback(_DOMAIN, self)
        else:
            socket.curve_serverkey = self._peer

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether the owner of a public key may connect; the authenticator calls it."""
        return key == self._peer

    def close(self) -> None:
        """Stop the authenticator; call it before the context ends."""
        if self._door is not None:
            self._door.stop()


def _key(file: Path) -> tuple[bytes, bytes | None]:
    """The public key and, if the file has it, the secret key, Z85. Raises UserError: there is no
    such file, or it holds no valid key."""
    where = f"link.options.curve = {str(file.parent)!r}: {file.name}"
    try:
        public, secret = zmq.auth.load_certificate(file)
        if len(z85.decode(public)) != _KEY_BYTES:
            raise ValueError
        if file.suffix == ".key_secret" and (not secret or zmq.curve_public(secret) != public):
            raise ValueError
    except OSError as problem:
        why = problem.strerror or "no such file"
        raise UserError(f"{where}: {why}; gfmhil keys makes one") from None
    except (ValueError, KeyError, struct.error, zmq.ZMQError):  # what decoding Z85 may raise
        raise UserError(f"{where}: holds no key that fits; gfmhil keys makes one") from None
    return public, secret


def _need_curve() -> None:
    if not zmq.has("curve"):
        raise UserError("this libzmq cannot encrypt: it was built without CURVE")
