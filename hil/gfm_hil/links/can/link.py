"""The CAN link: one side's node on a python-can bus, or on the socket that python-can opened."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import time
from pathlib import Path
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.links.can import LOOPBACK, CanOptions
from gfm_hil.links.can.emulation import busy, has_room
from gfm_hil.links.can.layout import Plan, load_plan
from gfm_hil.links.can.loopback import LoopbackBus
from gfm_hil.links.can.node import (
    ANOTHER_DBC,
    LOST,
    NOTHING,
    WENT_BUS_OFF,
    Node,
    account,
    bring,
    can_port,
    compose,
    fetch,
    put,
    receive,
    room_to_send,
)
from gfm_hil.links.can.segments import LONGEST, SegmentSender
from gfm_hil.links.can.sockets import FULL, SOCKETCAN, set_socket
from gfm_hil.links.can.wire import BRS, FD, frame_dtype, pack, unpack
from gfm_hil.links.frame import FrameWriter
from gfm_hil.links.port import Port
from gfm_runtime.signals import Vector, carried

# python-can also raises what it logs, and we print that in one line: silence its log
logging.getLogger("can").addHandler(logging.NullHandler())

_ROOM_S = 0.2  # how long a segment waits for room: the kernel's queue holds ten frames
_LOOK_S = 20e-6  # poll interval while a frame is on the emulated bus


class CanLink:
    """One end of the link; implements ``gfm_hil.links.Link``.

    Args:
        role: which side's frames to send.
        endpoint: ``can://channel`` or ``can+udp://127.0.0.1:port``.
        options: checked.

    Attributes:
        port: set if the bus is a socket, unless the options leave the frames to python-can.

    Raises:
        UserError: the bus or the DBC cannot be used.
    """

    port: Port | None = None

    def __init__(self, role: Role, endpoint: str, options: CanOptions) -> None:
        try:
            plan = load_plan(options)
        except ValueError as problem:
            raise UserError(f"link.options.{problem}") from None
        self._other, self._digest = ROLES[1 - ROLES.index(role)], plan.digest
        self._flags, self._where = options.fd * (FD | BRS), endpoint.partition("://")[2]
        self._node = Node(plan, role, options)
        self._cut = SegmentSender(plan, role)
        self._message, self._frame = np.zeros(LONGEST, np.uint8), np.zeros(1, frame_dtype)
        warm_up(plan)
        self._bus = _open_bus(role, endpoint, options)
        if not options.portable:
            self._reach(self._bus, options)

    def _reach(self, bus: Any, options: CanOptions) -> None:
        """Let the node use the bus directly, if it is a socket."""
        if isinstance(bus, LoopbackBus):
            self._node.sockets[:] = bus.record
        elif options.interface == "socketcan":
            set_socket(self._node.sockets, SOCKETCAN, bus.fileno())
        else:
            return
        self.port = can_port(self._node)

    @property
    def counters(self) -> dict[str, int]:
        """Counts of bus events, besides the faults that the frame reader counts."""
        n = self._node
        counted = {
            "foreign": n.state["foreign"],
            "incomplete": n.receiver["incomplete"],
            "damaged_messages": n.joiner["damaged"],
            "error_frames": n.state["error_frames"],
            "dropped": n.state["dropped"],
            "saturated": n.sender["saturated"],
        }
        return {name: int(count[0]) for name, count in counted.items()}

    def send(self, message: bytes) -> bool:
        """Send a message; False if the bus has no room for all of it.

        Raises:
            PeerLost: the bus is down.
        """
        count = compose(self._node.handle, np.frombuffer(message, np.uint8))
        if count != NOTHING:
            return all([self._put(self._node.out[k : k + 1]) for k in range(count)])
        until = time.monotonic() + _ROOM_S
        for segment in self._cut.frames(message):
            while not self._put_segment(*segment):
                if time.monotonic() >= until:
                    return False
                time.sleep(0.001)
        return True

    def _put_segment(self, number: int, payload: bytes) -> bool:
        frame = self._frame[0]
        frame["id"], frame["flags"], frame["length"] = number, self._flags, len(payload)
        frame["data"][: len(payload)] = np.frombuffer(payload, np.uint8)
        return self._put(self._frame)

    def _put(self, frame: NDArray[Any]) -> bool:
        node = self._node
        if self.port is not None:
            sent = bool(put(node.handle, frame))
            if node.state["lost"][0]:
                raise self._gone()
            return sent
        if not room_to_send(node.handle):
            return False
        try:
            self._bus.send(unpack(frame.tobytes()))
        except can.CanOperationError as problem:
            if problem.error_code not in (*FULL, None):  # no number: a full buffer, too
                raise self._gone(str(problem)) from None
            node.state["dropped"] += 1
            return False
        account(node.handle, frame)
        return True

    def receive(self) -> bytes | None:
        """The next message, or None.

        Raises:
            PeerLost: the bus is down, or the other side uses another DBC.
        """
        if self.port is None:
            while has_room(self._node.bus) and self._bring(0.0):
                pass
        size = receive(self._node.handle, self._message)
        if size == LOST:
            raise self._gone()
        return None if size == NOTHING else self._message[:size].tobytes()

    def _bring(self, timeout: float) -> bool:
        """Pass one frame from python-can to the node; False on timeout."""
        try:
            message = self._bus.recv(timeout)
        except can.CanOperationError as problem:
            raise self._gone(str(problem)) from None
        if message is None:
            return False
        datagram = np.frombuffer(pack(message), np.uint8)
        self._frame.view(np.uint8)[: len(datagram)] = datagram
        bring(self._node.handle, self._frame)
        return True

    def _gone(self, said: str = "") -> PeerLost:
        """The error that says why the bus is lost."""
        lost, self._node.state["lost"] = int(self._node.state["lost"][0]), 0
        if lost == WENT_BUS_OFF:
            return PeerLost(f"the CAN controller of {self._where} went bus off")
        if lost == ANOTHER_DBC:
            for segment in self._cut.frames(b""):  # so that the peer also detects the mismatch
                self._put_segment(*segment)
            theirs = int(self._node.joiner["theirs"][0])
            return PeerLost(
                f"the {self._other} uses another DBC, or one side alone has an inner stage "
                f"({theirs:08x}, ours is {self._digest:08x})"
            )
        return PeerLost(f"the CAN bus {self._where} is gone: {said or os.strerror(lost)}")

    def wait(self, seconds: float) -> bool:
        """Sleep until any frame has arrived, ours or foreign, at most ``seconds``."""
        node = self._node
        until = time.monotonic() + seconds
        while not fetch(node.handle):
            if node.state["lost"][0]:
                raise self._gone()
            left = until - time.monotonic()
            if left <= 0:
                return False
            pause = min(left, _LOOK_S) if busy(node.bus) else left
            if self.port is None:
                self._bring(pause)
            else:
                select.select([self._bus], [], [], pause)
        return True

    def close(self) -> None:
        """Leave the bus; the kernel still sends the frames that it has accepted."""
        self._node.state["open"] = 0
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


def warm_up(plan: Plan) -> None:
    """Compile (or load from the cache) what a tick calls, before the other side waits for it."""
    ends = {role: Node(plan, role, CanOptions(fd=plan.fd)) for role in ROLES}
    message = np.zeros(LONGEST, np.uint8)
    groups: tuple[tuple[Role, Vector], ...] = (("plant", "y"), ("controller", "u"))
    for role, group in groups:
        mine, theirs = ends[role].handle, ends[ROLES[1 - ROLES.index(role)]].handle
        values = np.zeros(len(carried(group, plan.inner)))
        words = FrameWriter(group, plan.inner).pack(0, 0, 0, values)
        for k in range(compose(mine, np.frombuffer(words, np.uint8))):
            account(mine, ends[role].out[k : k + 1])
            bring(theirs, ends[role].out[k : k + 1])
        fetch(theirs)
        receive(theirs, message)
        room_to_send(mine)
        can_port(ends[role])


def _open_bus(role: Role, endpoint: str, options: CanOptions) -> can.BusABC:
    scheme, _, channel = endpoint.partition("://")
    try:
        if scheme == LOOPBACK:
            return LoopbackBus(channel, place=ROLES.index(role))
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
    """Check that a SocketCAN interface is set up for CAN FD; sending would fail too late."""
    with contextlib.suppress(OSError):
        mtu = int(Path(f"/sys/class/net/{channel}/mtu").read_text(encoding="ascii"))
        if fd and mtu < 72:
            raise ValueError("not set up for CAN FD (mtu 72); link.options.fd = false?")
