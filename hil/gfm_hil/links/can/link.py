"""The CAN link: one side's node on a bus of python-can."""

from __future__ import annotations

import contextlib
import errno
import logging
import time
from collections import deque
from pathlib import Path
from typing import Any

import can
import numpy as np

from gfm_hil.errors import PeerLost, UserError
from gfm_hil.frames import FrameWriter
from gfm_hil.links.base import SIDES, Side
from gfm_hil.links.can.dbc import VECTORS
from gfm_hil.links.can.emulation import EmulatedBus
from gfm_hil.links.can.layout import Plan
from gfm_hil.links.can.loopback import LoopbackBus
from gfm_hil.links.can.options import LOOPBACK, CanOptions
from gfm_hil.links.can.plan import load_plan
from gfm_hil.links.can.segments import SegmentReceiver, SegmentSender
from gfm_hil.links.can.subrate import Subrate
from gfm_hil.links.can.vectors import CanFrame, VectorReceiver, VectorSender
from gfm_hil.links.port import Port
from gfm_runtime.signals import Group, names

# what python-can logs is in what it raises, which is told in a line of ours
logging.getLogger("can").addHandler(logging.NullHandler())

_FULL = (errno.ENOBUFS, errno.EAGAIN, None)  # python-can has no number for a full buffer
_ROOM_S = 0.2  # how long a segment waits for room: a kernel's queue takes ten frames
_AT_ONCE = 64  # frames looked at in one call, so that a flood of others' frames cannot hold it
_BUS_OFF = 0x40  # CAN_ERR_BUSOFF of linux/can/error.h, in an error frame's identifier


class CanLink:
    """One end of the link; implements ``gfm_hil.links.Link``.

    Args:
        side: which side's frames to send.
        endpoint: ``can://channel`` or ``can+udp://127.0.0.1:port``.
        options: checked.

    Raises:
        UserError: the bus or the DBC is not to be had.
    """

    port: Port | None = None

    def __init__(self, side: Side, endpoint: str, options: CanOptions) -> None:
        try:
            plan = load_plan(options)
        except ValueError as problem:
            raise UserError(f"link.options.{problem}") from None
        self._fd, self._where = options.fd, endpoint.partition("://")[2]
        mine: Group = "u" if side == "controller" else "y"
        theirs: Group = "y" if side == "controller" else "u"
        self._sender = VectorSender(plan, mine, options.heartbeat)
        self._receiver = VectorReceiver(plan, theirs)
        self._cut, self._join = SegmentSender(plan, side), SegmentReceiver(plan, side)
        self._inbox: deque[can.Message] = deque()
        self._foreign = self._error_frames = self._dropped = 0
        _compile(plan)
        self._subrate = Subrate(side, options.every, self._whole) if options.every > 1 else None
        bus = _open_bus(side, endpoint, options)
        rates = options.fd, options.bitrate, options.data_bitrate
        self._bus = EmulatedBus(bus, *rates) if options.emulate else bus

    @property
    def counters(self) -> dict[str, int]:
        """What happened on the bus besides the faults that the reader of frames counts."""
        return {
            "foreign": self._foreign,  # frames with identifiers that are not of this link
            "incomplete": self._receiver.incomplete,
            "damaged_messages": self._join.damaged,
            "error_frames": self._error_frames,
            "dropped": self._dropped,  # by us, for want of room
            "saturated": self._sender.saturated,
        }

    def send(self, message: bytes) -> bool:
        """Hand a message over; False if the bus has no room for all of it."""
        if self._subrate is not None and not self._subrate.goes(message):
            return True
        if self._sender.fits(message):
            return all([self._put(frame) for frame in self._sender.frames(message)])
        until = time.monotonic() + _ROOM_S
        for frame in self._cut.frames(message):
            while not self._put(frame):
                if time.monotonic() >= until:
                    return False
                time.sleep(0.001)
        return True

    def _put(self, frame: CanFrame) -> bool:
        message = can.Message(
            arbitration_id=frame[0], data=frame[1], is_extended_id=False,
            is_fd=self._fd, bitrate_switch=self._fd,
        )  # fmt: skip
        try:
            self._bus.send(message)
        except can.CanOperationError as problem:
            if problem.error_code not in _FULL:
                raise self._gone(problem) from None
            self._dropped += 1
            return False
        return True

    def receive(self) -> bytes | None:
        """The next message, or None.

        Raises:
            PeerLost: the bus is down, or the other side uses another DBC.
        """
        return self._whole() if self._subrate is None else self._subrate.receive()

    def _whole(self) -> bytes | None:
        """The next message that the bus itself brought."""
        for _ in range(_AT_ONCE):
            frame = self._inbox.popleft() if self._inbox else self._next(0.0)
            if frame is None:
                return None
            message = self._take(frame)
            if message is not None:
                return message
        return None

    def _take(self, frame: can.Message) -> bytes | None:
        if frame.is_error_frame:
            self._error_frames += 1
            if frame.arbitration_id & _BUS_OFF:
                raise PeerLost(f"the CAN controller of {self._where} went bus off")
        elif frame.is_extended_id or frame.is_remote_frame:
            self._foreign += 1
        elif self._receiver.knows(frame.arbitration_id):
            return self._receiver.take(frame.arbitration_id, bytes(frame.data))
        elif frame.arbitration_id == self._join.number:
            try:
                return self._join.take(bytes(frame.data))
            except PeerLost:
                for answer in self._cut.frames(b""):  # so that both sides see the misfit
                    self._put(answer)
                raise
        else:
            self._foreign += 1
        return None

    def _next(self, timeout: float) -> can.Message | None:
        try:
            return self._bus.recv(timeout)
        except can.CanOperationError as problem:
            raise self._gone(problem) from None

    def _gone(self, problem: can.CanOperationError) -> PeerLost:
        return PeerLost(f"the CAN bus {self._where} is gone: {problem}")

    def wait(self, seconds: float) -> bool:
        """Sleep until a frame is there, ours or not, at most ``seconds``."""
        if not self._inbox:
            frame = self._next(seconds)
            if frame is not None:
                self._inbox.append(frame)
        return bool(self._inbox)

    def close(self) -> None:
        """Leave the bus; frames handed over leave by themselves."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


def _compile(plan: Plan) -> None:
    """Compile (or load from cache) what a tick calls, before the other side waits for it."""
    for group in VECTORS:
        sender, receiver = VectorSender(plan, group, 1), VectorReceiver(plan, group)
        message = FrameWriter(group).pack(0, 0, 0, np.zeros(len(names(group))))
        for frame in sender.frames(message):
            receiver.take(*frame)


def _open_bus(side: Side, endpoint: str, options: CanOptions) -> can.BusABC:
    scheme, _, channel = endpoint.partition("://")
    try:
        if scheme == LOOPBACK:
            return LoopbackBus(channel, place=SIDES.index(side))
        if options.interface == "socketcan":
            _check_mtu(channel, options.fd)
        rates: dict[str, Any] = {"bitrate": options.bitrate, "fd": options.fd}
        if options.fd:
            rates["data_bitrate"] = options.data_bitrate
        return can.Bus(interface=options.interface, channel=channel, **rates)
    except (can.CanError, OSError, ValueError, ImportError, TypeError) as problem:
        said = str(problem)
        if isinstance(problem, OSError) and problem.errno == errno.EAFNOSUPPORT:
            said = f"this kernel has no CAN; {LOOPBACK}://127.0.0.1:port does without"
        raise UserError(f"link.endpoint = {endpoint!r}: cannot be opened: {said}") from None


def _check_mtu(channel: str, fd: bool) -> None:
    """See that a SocketCAN interface is set up for CAN FD, which sending would find too late."""
    with contextlib.suppress(OSError):
        mtu = int(Path(f"/sys/class/net/{channel}/mtu").read_text(encoding="ascii"))
        if fd and mtu < 72:
            raise ValueError("not set up for CAN FD (mtu 72); link.options.fd = false?")
