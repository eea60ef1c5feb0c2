"""What XCP packets travel on: UDP, or a CAN FD bus (ASAM MCD-1 XCP, part 3)."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self

import can

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import address
from gfm_hil.ports.xcp.slave import MOST, Slave

CAN_IDS = (0x7F0, 0x7F1)
"""Of the master's frames and of the slave's: the lowest priorities, so that a loop's frames on the
same bus go first."""
MOST_CAN = 64
"""Bytes of a frame, and so of a packet; 8 would not hold a command with a number."""
_LARGEST = 2048  # bytes of a datagram
_HIGHEST_ID = 0x7FF


class Transport(ABC):
    """Where a slave listens, once it is entered as a context.

    Attributes:
        most: bytes of a packet.
    """

    most: int

    @abstractmethod
    def __enter__(self) -> Self:
        """Listen; raises UserError if it cannot be opened."""

    @abstractmethod
    def __exit__(self, *_: object) -> None:
        """Close it."""

    @abstractmethod
    def words(self) -> str:
        """What it is, for people."""

    @abstractmethod
    def if_data(self) -> list[str]:
        """The lines of the A2L file that tell a tool where to find it."""

    @abstractmethod
    def answer(self, slave: Slave, seconds: float) -> None:
        """Let the slave answer what comes in that time; raises UserError if the bus is gone."""


class Udp(Transport):
    """A UDP port.

    Args:
        host, port: where to listen; port 0 is any.
    """

    most = MOST

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port

    def __enter__(self) -> Self:
        try:
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(*found[:3])
            self._socket.bind(found[4])
        except OSError as problem:
            where = f"--host {self._host} --port {self._port}"
            raise UserError(f"{where}: {problem.strerror}") from None
        self._port = self._socket.getsockname()[1]
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def words(self) -> str:
        return f"UDP {address(self._socket.getsockname())}"

    def if_data(self) -> list[str]:
        return [
            "  /begin XCP_ON_UDP_IP",
            f'    0x0100 {self._port} ADDRESS "{self._host}"',
            "  /end XCP_ON_UDP_IP",
        ]

    def answer(self, slave: Slave, seconds: float) -> None:
        line, until = self._socket, time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0 and select.select([line], [], [], left)[0]:
            datagram, peer = line.recvfrom(_LARGEST)
            said = slave.take(datagram, peer)
            if said:
                with contextlib.suppress(OSError):  # the master is gone
                    line.sendto(said, peer)


class CanFd(Transport):
    """A CAN FD bus of python-can: a frame is a packet, with zeros behind it up to the next length
    that a frame can have.

    Args:
        interface, channel: of python-can.
        ids: of the master's frames and of the slave's, 11 bits.

    Raises:
        UserError: an identifier that cannot be.
    """

    most = MOST_CAN

    def __init__(self, interface: str, channel: str, ids: Sequence[int] = CAN_IDS) -> None:
        if len(ids) != 2 or len({*ids}) != 2 or not all(0 <= i <= _HIGHEST_ID for i in ids):
            told = ",".join(f"{i:#x}" for i in ids)
            raise UserError(f"--ids {told}: must be two different ones of 0 to {_HIGHEST_ID:#x}")
        self._interface, self._channel = interface, channel
        self._theirs, self._mine = ids

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


def packed(line: Transport, timeout_ms: int, commands: Sequence[str]) -> list[str]:
    """The whole section of the A2L file on XCP.

    Args:
        timeout_ms: T1 and T2, ms.
        commands: optional ones that the slave has.
    """
    return [
        "/begin IF_DATA XCP",
        "  /begin PROTOCOL_LAYER",
        f"    0x0100 {timeout_ms} {timeout_ms} 0 0 0 0 0 {line.most} {line.most}",
        "    BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE",
        *(f"    OPTIONAL_CMD {name}" for name in commands),
        "  /end PROTOCOL_LAYER",
        *line.if_data(),
        "/end IF_DATA",
    ]
