"""ZeroMQ over ipc or tcp."""

from pathlib import Path

from gfm_hil.core.roles import Role
from gfm_hil.links.base import Link, LinkKind
from gfm_hil.links.zeromq.options import ZmqOptions, refuse_open


def _open(role: Role, endpoint: str, options: ZmqOptions) -> Link:
    from gfm_hil.links.zeromq.link import ZmqLink

    return ZmqLink(role, endpoint, options)


def _warm_up(options: ZmqOptions) -> None:
    from gfm_hil.links.zeromq.native import warm_up

    warm_up()


def _fresh(folder: Path) -> str:
    return f"ipc://{folder}/link"


_PORT = r"([1-9]\d{0,3}|[1-5]\d{4}|6[0-4]\d{3}|65[0-4]\d\d|655[0-2]\d|6553[0-5])"

KIND = LinkKind(
    name="zmq",
    text="ZeroMQ, on one machine or two",
    pattern=rf"ipc://.+|tcp://[^/\s]+:{_PORT}",
    form="ipc://path or tcp://host:port",
    fresh=_fresh,
    open=_open,
    options=ZmqOptions,
    check_both=refuse_open,
    warm_up=_warm_up,
)
