"""The serial link: one side's end of a line, which pyserial opens and sets up."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import struct
import termios
import time
import tty
from pathlib import Path

from gfm_hil.core.errors import PeerLost, UserError, need
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST
from gfm_hil.links.port import Port
from gfm_hil.links.serial import PTY, SerialOptions
from gfm_hil.links.serial.framing import Unstuffer, stuffed

_ROOM = 256  # bytes that may wait in the kernel when another message is sent
_AT_ONCE = 4096  # bytes of a read
_LOOK_S = 0.01  # poll interval while the other side's pseudo terminal is not there
_NONE_NOW = (errno.EAGAIN, errno.EINTR)

_DEFAULT = SerialOptions()


class SerialLink:
    """One end of the link; implements ``gfm_hil.links.Link``.

    Args:
        role: of a pseudo terminal the controller makes it, and the plant opens it.
        endpoint: ``serial://device`` or ``pty://path``, where the controller puts a symbolic link
            to its pseudo terminal.
        options: of the line.

    Raises:
        UserError: pyserial is missing, or the device cannot be opened, is in use, or belongs to
            another user. If the controller makes its pseudo terminal later, the plant's ``send``,
            ``receive`` and ``wait`` may raise it too.
    """

    port: Port | None = None  # a thread pumps the messages

    def __init__(self, role: Role, endpoint: str, options: SerialOptions = _DEFAULT) -> None:
        need("serial", "pyserial", f"link.endpoint = {endpoint!r}", "serial")
        self._endpoint, self._options = endpoint, options
        scheme, _, path = endpoint.partition("://")
        self._pty, self._path = scheme == PTY, Path(path)
        self._ends = contextlib.ExitStack()
        self._fd = -1
        self._into, self._rest, self._dropped = Unstuffer(), b"", 0
        if self._pty and role == "controller":
            self._make()
        else:
            self._there()

    @property
    def counters(self) -> dict[str, int]:
        """What the frame reader cannot count: damage before a message was whole, and messages of
        ours for which the line had no room."""
        return {"damaged_messages": self._into.damaged, "dropped": self._dropped}

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
            raise self._unusable("made", problem.strerror) from None
        self._ends.callback(self._path.unlink, missing_ok=True)
        self._fd = ours

    def _there(self) -> bool:
        """Whether the line is open; opens it as soon as possible."""
        if self._fd < 0 and (not self._pty or self._path.exists()):
            self._open()
        return self._fd >= 0

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
            raise self._unusable("opened", why) from None
        self._ends.callback(line.close)
        line.reset_input_buffer()  # what came before we were there
        self._fd = line.fileno()

    def _unusable(self, verb: str, why: str | None) -> UserError:
        return UserError(f"link.endpoint = {self._endpoint!r}: cannot be {verb}: {why}")

    def send(self, message: bytes) -> bool:
        """Send a message; False if the line has no room for it.

        Raises:
            PeerLost: the device is gone.
        """
        if len(message) > LONGEST or not self._there():
            return False
        if self._write(self._rest) and self._waiting() <= _ROOM:
            self._write(stuffed(message))
            return True
        self._dropped += 1
        return False

    def _waiting(self) -> int:
        """Bytes that the kernel has not yet sent."""
        try:
            answer = fcntl.ioctl(self._fd, termios.TIOCOUTQ, b"\0\0\0\0")
        except OSError as problem:  # the other side closed its pseudo terminal
            raise self._gone(problem) from None
        return int(struct.unpack("i", answer)[0])

    def _write(self, what: bytes) -> bool:
        """Write as much as there is room for, and keep the rest; whether that was all."""
        try:
            self._rest = what[os.write(self._fd, what) :] if what else b""
        except OSError as problem:
            if problem.errno not in _NONE_NOW:
                raise self._gone(problem) from None
            self._rest = what
        return not self._rest

    def receive(self) -> bytes | None:
        """The next message, or None.

        Raises:
            PeerLost: the device is gone.
        """
        message = self._into.next()
        if message is None and self._there():
            if self._rest:
                self._write(self._rest)
            try:
                came = os.read(self._fd, _AT_ONCE)
            except OSError as problem:
                if problem.errno not in _NONE_NOW:
                    raise self._gone(problem) from None
                return None
            if not came:
                return None
            self._into.feed(came)
            message = self._into.next()
        return message

    def _gone(self, problem: OSError) -> PeerLost:
        return PeerLost(f"the serial line {self._path} is gone: {problem.strerror}")

    def wait(self, seconds: float) -> bool:
        until = time.monotonic() + seconds
        while not self._there():
            left = until - time.monotonic()
            if left <= 0:
                return False
            time.sleep(min(_LOOK_S, left))
        left = max(until - time.monotonic(), 0.0)
        return bool(select.select([self._fd], [], [], left)[0])

    def close(self) -> None:
        """Close the line; the kernel still sends what it has accepted."""
        self._fd = -1
        self._ends.close()
