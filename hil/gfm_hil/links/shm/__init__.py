"""Shared memory between two processes on one machine."""

import secrets
from pathlib import Path

from gfm_hil.core.roles import Role
from gfm_hil.links.base import Link, LinkKind, LinkOptions


def _open(role: Role, endpoint: str, options: LinkOptions) -> Link:
    from gfm_hil.links.shm.link import ShmLink

    return ShmLink(role, endpoint)


def _warm_up(options: LinkOptions) -> None:
    from gfm_hil.links.ring import warm_up

    warm_up()


def _fresh(folder: Path) -> str:
    return f"shm://{secrets.token_hex(8)}"


KIND = LinkKind(
    name="shm",
    text="shared memory, two processes of one machine",
    pattern=r"shm://[A-Za-z0-9._-]{1,200}",
    form="shm://name, the name of 1 to 200 letters, digits, dots, dashes or underscores",
    fresh=_fresh,
    open=_open,
    warm_up=_warm_up,
)
