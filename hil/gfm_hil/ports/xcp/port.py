"""A run as the memory of an XCP slave: a port on UDP or a CAN FD bus (ASAM MCD-1 XCP, part 3)."""

import argparse
import contextlib
import select
import socket
import time
from pathlib import Path
from typing import Any, Self

import can

from gfm_hil.core.errors import UserError, naming
from gfm_hil.core.files import write_text
from gfm_hil.core.identity import address
from gfm_hil.ports.port import BesideRun, OperatorPort, say
from gfm_hil.ports.xcp.memory import Memory
from gfm_hil.ports.xcp.slave import MOST, Slave

_ANSWER_S = 0.1
_TIMEOUT_MS = 7000  # T1 and T2: a command to the run may take six seconds
_COMMANDS = (
    "GET_COMM_MODE_INFO", "GET_ID", "SET_MTA", "UPLOAD", "SHORT_UPLOAD", "DOWNLOAD",
    "SHORT_DOWNLOAD",
)  # fmt: skip
CAN_IDS = "0x7f0,0x7f1"
"""Of the master's frames and of the slave's: the lowest priorities, so that a loop's frames on the
same bus go first."""
MOST_CAN = 64
"""Bytes of a frame, and so of a packet; 8 would not hold a command with a number."""
_LARGEST = 2048  # bytes of a datagram
_HIGHEST_ID = 0x7FF


class Udp:
    """A UDP port at a host, open while in its context; port 0 is any."""

    most = MOST  # bytes of a packet

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port

    def __enter__(self) -> Self:
        """Listen. Raises UserError: it cannot be opened."""
        with naming(f"--host {self._host} --port {self._port}"):
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(*found[:3])
            self._socket.bind(found[4])
        self._port = self._socket.getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def words(self) -> str:
        """What it is, for people."""
        return f"UDP {address(self._socket.getsockname())}"

    def if_data(self) -> list[str]:
        """The lines of the A2L file that tell a tool where to find it."""
        return [
            "  /begin XCP_ON_UDP_IP",
            f'    0x0100 {self._port} ADDRESS "{self._host}"',
            "  /end XCP_ON_UDP_IP",
        ]

    def answer(self, slave: Slave, seconds: float) -> None:
        """Let the slave answer what comes in that time."""
        line, until = self._socket, time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and select.select([line], [], [], left)[0]:
            datagram, peer = line.recvfrom(_LARGEST)
            said = slave.take(datagram, peer)
            if said:
                with contextlib.suppress(OSError):  # the master is gone
                    line.sendto(said, peer)


class CanFd:
    """A CAN FD bus of python-can, used as ``Udp`` is; a frame is a packet, with zeros behind it up
    to the next length that a frame can have. Raises UserError: identifiers that cannot be.

    Args:
        interface, channel: of python-can.
        ids: of the master's frames and of the slave's, 11 bits, as ``0x7f0,0x7f1``.
    """

    most = MOST_CAN

    def __init__(self, interface: str, channel: str, ids: str = CAN_IDS) -> None:
        try:
            found = [int(part, 0) for part in ids.split(",")]
        except ValueError:
            raise UserError(f"--ids {ids}: must be two numbers, as 0x7f0,0x7f1") from None
        if len(found) != 2 or len({*found}) != 2 or not all(0 <= i <= _HIGHEST_ID for i in found):
            told = ",".join(f"{i:#x}" for i in found)
            raise UserError(f"--ids {told}: must be two different ones of 0 to {_HIGHEST_ID:#x}")
        self._interface, self._channel = interface, channel
        self._theirs, self._mine = found

    def __enter__(self) -> Self:
        only = [{"can_id": self._theirs, "can_mask": _HIGHEST_ID, "extended": False}]
        try:
            self._bus = can.Bus(
                interface=self._interface, channel=self._channel, fd=True, can_filters=only
            )
        except (can.CanError, OSError, ValueError, ImportError, TypeError) as problem:
            where = f"--can {self._channel} --interface {self._interface}"
            raise UserError(f"{where}: cannot be opened: {problem}") from None
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def words(self) -> str:
        return f"CAN FD {self._channel}, {self._theirs:#x} and {self._mine:#x}"

    def if_data(self) -> list[str]:
        return [
            "  /begin XCP_ON_CAN",
            "    0x0100",
            f"    CAN_ID_MASTER {self._theirs:#x}",
            f"    CAN_ID_SLAVE {self._mine:#x}",
            "    BAUDRATE 1000000",
            "    /begin CAN_FD",
            f"      MAX_DLC {MOST_CAN}",
            "      CAN_FD_DATA_TRANSFER_BAUDRATE 8000000",
            "    /end CAN_FD",
            "  /end XCP_ON_CAN",
        ]

    def answer(self, slave: Slave, seconds: float) -> None:
        """As ``Udp.answer``. Raises UserError: the bus is gone."""
        bus, until = self._bus, time.monotonic() + seconds
        try:
            while (left := until - time.monotonic()) > 0 and (heard := bus.recv(left)) is not None:
                if heard.arbitration_id != self._theirs or heard.is_error_frame:
                    continue
                said = slave.packet(bytes(heard.data), (self._channel, self._theirs))
                if said:
                    bus.send(self._frame(said))
        except (can.CanError, OSError) as problem:
            raise UserError(f"--can {self._channel}: the bus is gone: {problem}") from None

    def _frame(self, packet: bytes) -> can.Message:
        size = can.util.dlc2len(can.util.len2dlc(len(packet)))
        return can.Message(
            arbitration_id=self._mine, is_extended_id=False, is_fd=True, bitrate_switch=True,
            data=packet.ljust(size, b"\0"),
        )  # fmt: skip


def xcp_section(line: Udp | CanFd) -> list[str]:
    """The A2L file's section on XCP: T1 and T2, and the optional commands that there are."""
    return [
        "/begin IF_DATA XCP",
        "  /begin PROTOCOL_LAYER",
        f"    0x0100 {_TIMEOUT_MS} {_TIMEOUT_MS} 0 0 0 0 0 {line.most} {line.most}",
        "    BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE",
        *(f"    OPTIONAL_CMD {name}" for name in _COMMANDS),
        "  /end PROTOCOL_LAYER",
        *line.if_data(),
        "/end IF_DATA",
    ]


class XcpPort(OperatorPort):
    """The slave of ``gfmhil xcp``."""

    risk = "and XCP neither encrypts nor asks who calls"
    opens = (
        "--plain",
        "listen beyond this machine: everybody there can read, and with --write command",
    )
    commands = True
    socket = socket.SOCK_DGRAM

    def options(self, command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--can", metavar="CHANNEL", help="listen on this CAN FD bus instead, e.g. can0"
        )
        command.add_argument(
            "--interface", default="socketcan", help="python-can's name of its driver (%(default)s)"
        )
        command.add_argument(
            "--ids", metavar="MASTER,SLAVE", default=CAN_IDS,
            help=f"identifiers of the frames on the bus ({CAN_IDS})",
        )  # fmt: skip
        command.add_argument(
            "--write", action="store_true", help="let tools write references, the law and its gains"
        )
        command.add_argument(
            "--a2l", type=Path, metavar="FILE", help="write the A2L file of this run, and end"
        )

    def check(self, options: argparse.Namespace) -> None:
        super().check(options)
        self.line: Udp | CanFd = Udp(options.host, options.port)
        if options.can is not None:
            self.line = CanFd(options.interface, options.can, options.ids)

    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        run.wait()
        operator = run.operator(run.folder)

        def now() -> dict[str, Any] | None:
            snapshot = operator.snapshot()
            return snapshot if "laws" in snapshot else None

        first = run.first(now)
        memory = Memory(
            operator, first["laws"], "limited" in first, lambda: operator.run.done("controller")
        )

        def a2l() -> str:
            return memory.a2l("bench", xcp_section(self.line))

        if options.a2l is not None:
            write_text(options.a2l, a2l())
            return 0
        with self.line:
            slave = Slave(memory, "gfmhil", a2l(), options.write, say, most=self.line.most)
            kind = "read and write" if options.write else "read only"
            say(f"XCP on {self.line.words()}, {kind}")
            while not run.over():
                self.line.answer(slave, _ANSWER_S)
        return 0
