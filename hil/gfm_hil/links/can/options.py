"""Options of the CAN link, the table ``link.options`` of a scenario."""

from __future__ import annotations

from pydantic import Field

from gfm_hil.links.base import LinkOptions

LOOPBACK = "can+udp"


class CanOptions(LinkOptions):
    """How to reach the bus and how fast it is.

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
