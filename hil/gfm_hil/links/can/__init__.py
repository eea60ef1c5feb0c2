"""CAN and CAN FD through python-can, and a bus on the loopback device."""

import secrets
import socket
from pathlib import Path

from pydantic import Field

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.links.base import Link, LinkKind, LinkOptions

LOOPBACK = "can+udp"  # scheme of endpoints on the loopback bus
LOOPBACK_PLACES = 4  # of a loopback bus: consecutive UDP ports


class CanOptions(LinkOptions):
    """The table ``link.options``: how to reach the bus and how fast it is.

    SocketCAN uses the bit rates that its interface was set up with (``ip link``); they are
    repeated here to check the period against the bus time.
    """

    interface: str = Field("socketcan", description="python-can's name of the backend")
    fd: bool = Field(True, description="CAN FD, or classic CAN")
    bitrate: int = Field(1_000_000, ge=10_000, le=1_000_000, description="of arbitration, bit/s")
    data_bitrate: int = Field(
        8_000_000, ge=10_000, le=8_000_000, description="of a CAN FD frame's data, bit/s"
    )
    every: int = Field(1, ge=1, le=50, description="ticks to an exchange; held in between")
    dbc: str | None = Field(None, description="DBC file in place of the one of `gfmhil dbc`")
    heartbeat: int = Field(
        10_000, ge=1, le=10**9, description="vectors after which a state is said again"
    )
    portable: bool = Field(
        False, description="leave the frames to python-can, where calling the kernel is unwanted"
    )
    emulate: bool = Field(
        False, description="make a virtual bus as late as one of these bit rates; real time only"
    )


def _open(role: Role, endpoint: str, options: CanOptions) -> Link:
    from gfm_hil.links.can.link import CanLink

    return CanLink(role, endpoint, options)


def _warm_up(options: CanOptions) -> None:
    from gfm_hil.links.can.layout import load_plan
    from gfm_hil.links.can.link import warm_up

    warm_up(load_plan(options))


def _check(options: CanOptions, T_s: float) -> None:
    from gfm_hil.links.can.bus_time import check_budget

    check_budget(options, T_s)


def _refuse_unused(endpoint: str | None, options: CanOptions) -> None:
    """Check that the backend named in the options is the one that carries the frames. Raises
    ValueError: it is not."""
    named = "interface" in options.model_fields_set
    if named and (endpoint is None or endpoint.startswith(LOOPBACK)):
        said = "no endpoint" if endpoint is None else f"endpoint = {endpoint!r}"
        raise ValueError(
            f"options.interface = {options.interface!r} with {said}, which is the loopback bus: "
            "set endpoint = 'can://channel' with a channel of that interface"
        )


def _fresh(folder: Path) -> str:
    """A loopback bus on free ports below the kernel's ephemeral range."""
    begin = secrets.randbelow(2500)  # so that two runs that start together take different ports
    for k in range(2500):
        first = 20_000 + LOOPBACK_PLACES * ((begin + k) % 2500)
        probes = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(LOOPBACK_PLACES)]
        try:
            for place, probe in enumerate(probes):
                probe.bind(("127.0.0.1", first + place))
            return f"{LOOPBACK}://127.0.0.1:{first}"
        except OSError:
            continue
        finally:
            for probe in probes:
                probe.close()
    raise UserError("link: no free UDP ports for a loopback bus between 20000 and 30000")


_PORT = r"(102[4-9]|10[3-9]\d|1[1-9]\d\d|[2-9]\d{3}|[1-5]\d{4}|6[0-4]\d{3}|65[0-4]\d\d|655[0-2]\d)"

KIND = LinkKind(
    name="can",
    text="CAN and CAN FD, values in 16 bits",
    pattern=rf"can://\S+|{LOOPBACK.replace('+', '[+]')}://127\.0\.0\.1:{_PORT}",
    form=f"can://channel (as can://can0) or {LOOPBACK}://127.0.0.1:port, 1024 to 65529",
    fresh=_fresh,
    open=_open,
    options=CanOptions,
    check=_check,
    check_both=_refuse_unused,
    warm_up=_warm_up,
    exact=False,
)
