"""A serial line: UART, USB-CDC or RS-485, and a pseudo terminal on one machine."""

from pathlib import Path

from pydantic import Field

from gfm_hil.core.roles import Role
from gfm_hil.links.base import Link, LinkKind, LinkOptions

PTY = "pty"  # scheme of endpoints at a pseudo terminal


class SerialOptions(LinkOptions):
    """The table ``link.options``: how the line is set up; 8 data bits, no parity, 1 stop bit."""

    baud: int = Field(1_000_000, ge=1200, le=50_000_000, description="bit rate of the line, bit/s")
    rtscts: bool = Field(False, description="have the wires RTS and CTS hold the sender up")


def _open(role: Role, endpoint: str, options: SerialOptions) -> Link:
    from gfm_hil.links.serial.link import SerialLink

    return SerialLink(role, endpoint, options)


def _warm_up(options: LinkOptions) -> None:
    from gfm_hil.links.serial.line import warm_up

    warm_up()


def _fresh(folder: Path) -> str:
    return f"{PTY}://{folder}/line"


KIND = LinkKind(
    name="serial",
    text="a serial line, or a pseudo terminal",
    pattern=rf"(serial|{PTY})://.+",
    form=f"serial://device (as serial:///dev/ttyACM0) or {PTY}://path",
    fresh=_fresh,
    open=_open,
    options=SerialOptions,
    warm_up=_warm_up,
)
