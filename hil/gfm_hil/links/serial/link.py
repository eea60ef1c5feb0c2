"""The serial link: one side's end of a line, which pyserial opens and sets up."""

import contextlib
import os
import select
import time
import tty
from pathlib import Path

import numpy as np

from gfm_hil.core.errors import PeerLost, need
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST, unusable, wait_until
from gfm_hil.links.serial import PTY, SerialOptions
from gfm_hil.links.serial.line import (
    COUNT_DAMAGED,
    DROPPED,
    FD,
    GONE,
    line_port,
    make_line,
    receive,
    send,
    set_line,
)

_POLL_S = 0.01  # poll interval while the other side's pseudo terminal is not there

_DEFAULT = SerialOptions()


class SerialLink:
    """One end of the link; implements ``gfm_hil.links.Link``. Raises UserError: pyserial is
    missing, or the device cannot be opened, is in use, or belongs to another user. If the
    controller makes its pseudo terminal later, the plant's ``send``, ``receive`` and ``wait`` may
    raise it too.

    Args:
        role: of a pseudo terminal the controller makes it, and the plant opens it.
        endpoint: ``serial://device`` or ``pty://path``, where the controller puts a symbolic link
            to its pseudo terminal.
        options: of the line.
    """

    def __init__(self, role: Role, endpoint: str, options: SerialOptions = _DEFAULT) -> None:
        need("serial", "pyserial", f"link.endpoint = {endpoint!r}", "serial")
        self._endpoint, self._options = endpoint, options
        scheme, _, path = endpoint.partition("://")
        self._pty, self._path = scheme == PTY, Path(path)
        self._ends = contextlib.ExitStack()
        self._line, self._message = make_line(), np.zeros(LONGEST, np.uint8)
        self.port = line_port(self._line)
        if self._pty and role == "controller":
            self._make()
        else:
            self._there()

    @property
    def counters(self) -> dict[str, int]:
        """What the frame reader cannot count: damage before a message was whole, and messages of
        ours for which the line had no room."""
        line = self._line
        return {"damaged_messages": int(line[COUNT_DAMAGED]), "dropped": int(line[DROPPED])}

    def _make(self) -> None:
        """Make a pseudo terminal, and the symbolic link to it."""
        ours, theirs = os.openpty()
        for fd in (ours, theirs):  # ours of both, so that a plant that leaves hangs nothing up
            self._ends.callback(os.close, fd)
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        try:
            if self._path.is_symlink() and not self._path.exists():
                self._path.unlink()  # a killed run left it
            self._path.symlink_to(os.ttyname(theirs))
        except OSError as problem:
            self._ends.close()
            raise unusable(self._endpoint, "made", problem.strerror) from None
        self._ends.callback(self._path.unlink, missing_ok=True)
        set_line(self._line, ours)

    def _there(self) -> bool:
        """Whether the line is open; opens it as soon as possible."""
        if self._line[FD] < 0 and (not self._pty or self._path.exists()):
            self._open()
        return bool(self._line[FD] >= 0)

    def _open(self) -> None:
        import serial

        try:
            if self._pty and self._path.stat().st_uid != os.geteuid():
                raise ValueError("it belongs to another user")
            line = serial.Serial(
                str(self._path), self._options.baud, rtscts=self._options.rtscts, exclusive=True
            )
        except (OSError, ValueError) as problem:  # SerialException is an OSError
            number = getattr(problem, "errno", None)
            why = os.strerror(number) if number else str(problem)
            raise unusable(self._endpoint, "opened", why) from None
        self._ends.callback(line.close)
        line.reset_input_buffer()  # what came before we were there
        set_line(self._line, line.fileno())

    def send(self, message: bytes) -> bool:
        """Send a message; False if the line has no room for it. Raises PeerLost: the device is
        gone."""
        if not self._there():
            return False
        sent = send(self._line, np.frombuffer(bytearray(message), np.uint8))
        if self._line[GONE]:
            raise self._gone()
        return bool(sent)

    def receive(self) -> bytes | None:
        """The next message, or None. Raises PeerLost: the device is gone."""
        if not self._there():
            return None
        size = receive(self._line, self._message)
        if size < 0:
            raise self._gone()
        return self._message[:size].tobytes() if size else None

    def _gone(self) -> PeerLost:
        """The error that says why the line is gone."""
        why, self._line[GONE] = int(self._line[GONE]), 0
        return PeerLost(f"the serial line {self._path} is gone: {os.strerror(why)}")

    def wait(self, seconds: float) -> bool:
        until = time.monotonic() + seconds
        if not wait_until(self._there, until, _POLL_S, _POLL_S):
            return False
        left = max(until - time.monotonic(), 0.0)
        return bool(select.select([self], [], [], left)[0])

    def fileno(self) -> int:
        """The file descriptor of the line; -1: it is not open."""
        return int(self._line[FD])

    def close(self) -> None:
        """Close the line; the kernel still sends what it has accepted."""
        set_line(self._line, -1)
        self._ends.close()
