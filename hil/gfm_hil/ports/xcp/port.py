"""A run as the memory of an XCP slave, as a port."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.core.files import write_text
from gfm_hil.ports.port import BesideRun, OperatorPort, say
from gfm_hil.ports.xcp.memory import Memory
from gfm_hil.ports.xcp.slave import Slave
from gfm_hil.ports.xcp.transports import CanFd, Transport, Udp, packed
from gfm_hil.recording.live import LiveRun

_ANSWER_S = 0.1
_TIMEOUT_MS = 7000  # T1: a command to the run may take six seconds
_COMMANDS = (
    "GET_COMM_MODE_INFO", "GET_ID", "SET_MTA", "UPLOAD", "SHORT_UPLOAD", "DOWNLOAD",
    "SHORT_DOWNLOAD",
)  # fmt: skip


class XcpPort(OperatorPort):
    """The slave of ``gfmhil xcp``."""

    text = (
        "Serve a run that is going on to a calibration tool, as an XCP slave on UDP or CAN FD, to "
        "its end."
    )
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
            "--ids", metavar="MASTER,SLAVE",
            help="identifiers of the frames on the bus (0x7f0,0x7f1)",
        )  # fmt: skip
        command.add_argument(
            "--write", action="store_true", help="let tools write references, the law and its gains"
        )
        command.add_argument(
            "--a2l", type=Path, metavar="FILE", help="write the A2L file of this run, and end"
        )

    def check(self, options: argparse.Namespace) -> None:
        super().check(options)
        self.line: Transport = Udp(options.host, options.port)
        if options.can is not None:
            self.line = CanFd(options.interface, options.can, *_identifiers(options.ids))

    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        run.wait()
        operator, recorded = run.operator(), LiveRun(run.folder)

        def now() -> dict[str, Any] | None:
            snapshot = operator.snapshot()
            return snapshot if "laws" in snapshot else None

        first = run.first(now)
        memory = Memory(
            operator, first["laws"], "limited" in first, lambda: recorded.done("controller")
        )

        def a2l() -> str:
            return memory.a2l("bench", packed(self.line, _TIMEOUT_MS, _COMMANDS))

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


def _identifiers(text: str | None) -> list[list[int]]:
    """The identifiers as arguments, none if not given.

    Raises:
        UserError: they are no numbers.
    """
    try:
        return [] if text is None else [[int(part, 0) for part in text.split(",")]]
    except ValueError:
        raise UserError(f"--ids {text}: must be two numbers, as 0x7f0,0x7f1") from None
