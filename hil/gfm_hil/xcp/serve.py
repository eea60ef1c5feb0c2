"""Serves a run in progress to a calibration tool over UDP, to the run's end."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import address
from gfm_hil.core.stopping import Interrupt
from gfm_hil.engine.announcement import not_running, present
from gfm_hil.links.zeromq.options import beyond_loopback
from gfm_hil.operator import Operator
from gfm_hil.recording.live import LiveRun
from gfm_hil.xcp.memory import Memory
from gfm_hil.xcp.slave import MOST, Slave

_LARGEST = 2048  # bytes of a datagram
_LOOK_S = 0.1
_NICENESS = 5  # the loop comes first
_TIMEOUT_MS = 7000  # T1: a command to the run may take six seconds


def check_address(host: str, port: int, plain: bool) -> None:
    """Refuse an address that cannot be, or that others reach though nobody said so.

    Raises:
        UserError: the address is such.
    """
    if not 0 <= port <= 65535:
        raise UserError(f"--port {port}: must be 0 (any) to 65535")
    if not plain and beyond_loopback(f"tcp://{host}:0"):
        raise UserError(
            f"--host {host}: goes beyond this machine, and XCP neither encrypts nor asks who "
            "calls; --plain if it shall"
        )


def live_a2l(folder: Path, host: str, port: int) -> str:
    """The A2L file of a run in progress, for a slave at that address.

    Raises:
        UserError: no run is going on there.
    """
    operator = Operator(folder, through="xcp")
    try:
        return _a2l(_memory(folder, operator), host, port)
    finally:
        operator.close()


def serve(folder: Path, host: str, port: int, writes: bool, notice: Callable[[str], None]) -> None:
    """Serve the run in ``folder`` until it ends, or until SIGINT or SIGTERM.

    Raises:
        UserError: no run is in progress there, or the address cannot be bound.
    """
    operator = Operator(folder, through="xcp")
    with contextlib.ExitStack() as stack:
        stack.callback(operator.close)
        interrupt = stack.enter_context(Interrupt())
        memory = _memory(folder, operator)
        line = stack.enter_context(_bound(host, port))
        at = line.getsockname()
        kind = "read and write" if writes else "read only"
        slave = Slave(memory, "gfmhil", _a2l(memory, host, at[1]), writes, notice)
        with contextlib.suppress(OSError):
            os.nice(_NICENESS)
        notice(f"XCP on UDP {address(at)}, {kind}")
        while not interrupt.came and present(folder):
            until = time.monotonic() + _LOOK_S  # also a busy master lets us look
            while (left := until - time.monotonic()) > 0 and select.select([line], [], [], left)[0]:
                datagram, peer = line.recvfrom(_LARGEST)
                answer = slave.take(datagram, peer)
                if answer:
                    with contextlib.suppress(OSError):  # the master is gone
                        line.sendto(answer, peer)


def _bound(host: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        line = socket.socket(family, kind, protocol)
        try:
            line.bind(where)
        except OSError:
            line.close()
            raise
    except OSError as problem:
        raise UserError(f"--host {host} --port {port}: {problem.strerror}") from None
    return line


def _memory(folder: Path, operator: Operator) -> Memory:
    run = LiveRun(folder)
    while "laws" not in (now := operator.snapshot()):
        if not present(folder):
            raise not_running(folder)
        time.sleep(_LOOK_S)
    return Memory(operator, now["laws"], "limited" in now, lambda: run.done("controller"))


def _a2l(memory: Memory, host: str, port: int) -> str:
    commands = (
        "GET_COMM_MODE_INFO", "GET_ID", "SET_MTA", "UPLOAD", "SHORT_UPLOAD", "DOWNLOAD",
        "SHORT_DOWNLOAD",
    )  # fmt: skip
    return memory.a2l(
        "bench",
        [
            "/begin IF_DATA XCP",
            "  /begin PROTOCOL_LAYER",
            f"    0x0100 {_TIMEOUT_MS} {_TIMEOUT_MS} 0 0 0 0 0 {MOST} {MOST}",
            "    BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE",
            *(f"    OPTIONAL_CMD {name}" for name in commands),
            "  /end PROTOCOL_LAYER",
            "  /begin XCP_ON_UDP_IP",
            f'    0x0100 {port} ADDRESS "{host}"',
            "  /end XCP_ON_UDP_IP",
            "/end IF_DATA",
        ],
    )
