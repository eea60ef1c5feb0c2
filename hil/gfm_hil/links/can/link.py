"""The CAN link: one side's node on a socket, and the handshake over ISO-TP (ISO 15765-2)."""

import contextlib
import errno
import logging
import os
import select
import time
from collections import deque
from pathlib import Path
from typing import Any

import can
import isotp
import numpy as np

from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.roles import OTHER, ROLES, Role
from gfm_hil.links.base import LONGEST, unusable
from gfm_hil.links.can import LOOPBACK, CanOptions
from gfm_hil.links.can.bridge import Bridge
from gfm_hil.links.can.dbc import SENDERS
from gfm_hil.links.can.emulation import busy
from gfm_hil.links.can.layout import Plan, load_plan
from gfm_hil.links.can.loopback import LoopbackBus
from gfm_hil.links.can.node import (
    LOST,
    NOTHING,
    TRANSPORT,
    WENT_BUS_OFF,
    Node,
    can_port,
    fetch,
    process,
    put,
    receive,
    send,
)
from gfm_hil.links.can.sockets import SOCKETCAN, set_socket
from gfm_hil.links.can.wire import BRS, FD, MOST, frame_dtype
from gfm_hil.links.frame import FrameWriter
from gfm_hil.links.port import Port
from gfm_runtime.signals import carried

# both also raise or report what they log, and we print that in one line: silence their logs
for _name in ("can", "isotp"):
    logging.getLogger(_name).addHandler(logging.NullHandler())

_PATIENCE_S = 0.2  # for a peer that takes a message of the handshake, and for room in the kernel
_POLL_S = 20e-6  # poll interval while a frame is on the emulated bus
_DIGEST_BYTES = 4  # before each message of the handshake
#: what else can-isotp reports happens where one side is not there yet, or begins anew
_DAMAGE = (
    isotp.InvalidCanDataError,
    isotp.WrongSequenceNumberError,
    isotp.ChangingInvalidRXDLError,
    isotp.MissingEscapeSequenceError,
    isotp.FrameTooLongError,
)


class CanLink:
    """One end of the link; implements ``gfm_hil.links.Link``. Raises UserError: the bus or the DBC
    cannot be used.

    Args:
        role: which side's frames to send.
        endpoint: ``can://channel`` or ``can+udp://127.0.0.1:port``.
        options: checked.

    Attributes:
        every: ticks to an exchange of y and u.
    """

    def __init__(self, role: Role, endpoint: str, options: CanOptions) -> None:
        try:
            plan = load_plan(options)
        except ValueError as problem:
            raise UserError(f"link.options.{problem}") from None
        self._other, self._digest = OTHER[role], plan.digest
        self._flags, self._where = options.fd * (FD | BRS), endpoint.partition("://")[2]
        self._node = Node(plan, role, options)
        self._message, self._frame = np.zeros(MOST, np.uint8), np.zeros(1, frame_dtype)
        self._early: deque[bytes] = deque()  # frames of the loops that came with the handshake's
        self._damaged, self.every = 0, options.every
        self._transport = self._make_transport(plan, role, options.fd)
        warm_up(plan)
        self._bus = _open_bus(role, endpoint, options)
        direct = isinstance(self._bus, LoopbackBus) or options.interface == "socketcan"
        if options.portable or not direct:
            self._bus = Bridge(self._bus)
        if isinstance(self._bus, LoopbackBus):
            self._node.sockets[:] = self._bus.record
        else:
            set_socket(self._node.sockets, SOCKETCAN, self._bus.fileno())
        self.port: Port = can_port(self._node)

    def _make_transport(self, plan: Plan, role: Role, fd: bool) -> isotp.TransportLayerLogic:
        mine, theirs = plan.transport[role], plan.transport[self._other]
        return isotp.TransportLayerLogic(
            rxfn=self._next_of_transport,
            txfn=self._put_of_transport,
            address=isotp.Address(isotp.AddressingMode.Normal_11bits, txid=mine, rxid=theirs),
            error_handler=self._count,
            params={
                "tx_data_length": 64 if fd else 8,
                "can_fd": fd,
                "bitrate_switch": fd,
                "blocksize": 0,
                "max_frame_size": _DIGEST_BYTES + LONGEST,
                "rx_flowcontrol_timeout": round(2000 * _PATIENCE_S),  # ``send`` gives up before
            },
        )

    @property
    def counters(self) -> dict[str, int]:
        """Counts of bus events, besides the faults that the frame reader counts."""
        state, sender, receiver = self._node.state[0], self._node.sender[0], self._node.receiver[0]
        return {
            "foreign": int(state["foreign"]),
            "incomplete": int(receiver["incomplete"]),
            "error_frames": int(state["error_frames"]),
            "dropped": int(state["dropped"]) + getattr(self._bus, "dropped", 0),
            "saturated": int(sender["saturated"]),
            "damaged_messages": self._damaged,
        }

    def send(self, message: bytes) -> bool:
        """Send a message; False if the bus has no room for all of it, or if it is one of the
        handshake that the peer did not take. Raises PeerLost: the bus is down."""
        if len(message) > LONGEST:
            return False
        sent = send(self._node.handle, np.frombuffer(bytearray(message), np.uint8))
        if self._node.state["lost"][0]:
            raise self._gone()
        return self._send_by_transport(message) if sent == NOTHING else bool(sent)

    def _send_by_transport(self, message: bytes) -> bool:
        layer, until = self._transport, time.monotonic() + _PATIENCE_S
        layer.send(self._digest.to_bytes(_DIGEST_BYTES, "little") + message)
        while True:
            layer.process()
            if not layer.transmitting():
                return True
            if time.monotonic() >= until:
                layer.stop_sending()
                return False
            self.wait(1e-3)

    def _put_of_transport(self, message: isotp.CanMessage) -> None:
        frame, until = self._frame[0], time.monotonic() + _PATIENCE_S
        frame["id"], frame["flags"] = message.arbitration_id, self._flags
        frame["length"] = len(message.data)
        frame["data"][: len(message.data)] = np.frombuffer(message.data, np.uint8)
        while not put(self._node.handle, self._frame) and time.monotonic() < until:
            if self._node.state["lost"][0]:
                raise self._gone()
            time.sleep(1e-3)  # the kernel's queue holds ten frames

    def _next_of_transport(self, timeout: float = 0.0) -> isotp.CanMessage | None:
        """The next frame of the handshake; none after a message that is to be taken first."""
        while not self._early and not self._transport.available():
            size = receive(self._node.handle, self._message)
            if size == LOST:
                raise self._gone()
            if size == NOTHING:
                return None
            if size == TRANSPORT:
                frame = self._node.into[0]
                data = frame["data"][: frame["length"]].tobytes()
                return isotp.CanMessage(int(frame["id"]), data=data)
            self._early.append(self._message[:size].tobytes())
        return None

    def _count(self, problem: Exception) -> None:
        self._damaged += isinstance(problem, _DAMAGE)

    def receive(self) -> bytes | None:
        """The next message, or None. Raises PeerLost: the bus is down, or the other side uses
        another DBC."""
        self._transport.process()
        message = self._transport.recv()
        if message is None:
            return self._early.popleft() if self._early else None
        theirs = int.from_bytes(message[:_DIGEST_BYTES], "little")
        if theirs != self._digest:
            self._send_by_transport(b"")  # so that the peer also detects the mismatch
            raise PeerLost(
                f"the {self._other} uses another DBC, or one side alone has an inner stage "
                f"({theirs:08x}, ours is {self._digest:08x})"
            )
        return bytes(message[_DIGEST_BYTES:])

    def _gone(self) -> PeerLost:
        """The error that says why the bus is lost."""
        lost, self._node.state["lost"] = int(self._node.state["lost"][0]), 0
        if lost == WENT_BUS_OFF:
            return PeerLost(f"the CAN controller of {self._where} went bus off")
        why = getattr(self._bus, "problem", "") or os.strerror(lost)
        return PeerLost(f"the CAN bus {self._where} is gone: {why}")

    def wait(self, seconds: float) -> bool:
        """Sleep until any frame has arrived, ours or foreign, at most ``seconds``."""
        node = self._node
        until = time.monotonic() + seconds
        while not (self._early or fetch(node.handle)):
            if node.state["lost"][0]:
                raise self._gone()
            left = until - time.monotonic()
            if left <= 0:
                return False
            select.select([self._bus], [], [], min(left, _POLL_S) if busy(node.bus) else left)
        return True

    def close(self) -> None:
        """Leave the bus; the kernel still sends the frames that it has accepted."""
        self._node.state["open"] = 0
        with contextlib.suppress(can.CanError, OSError):
            self._bus.shutdown()


def warm_up(plan: Plan) -> None:
    """Compile (or load from the cache) what a tick calls, before the other side waits for it."""
    ends = {role: Node(plan, role, CanOptions(fd=plan.fd)) for role in ROLES}
    message = np.zeros(MOST, np.uint8)
    for group, role in SENDERS.items():
        mine, theirs = ends[role], ends[OTHER[role]]
        mine.sockets["fd"] = mine.sockets["others"] = -1  # no socket: nothing is sent or received
        values = np.zeros(len(carried(group, plan.signal_set)))
        words = FrameWriter(group, plan.signal_set).pack(0, 0, 0, values)
        send(mine.handle, np.frombuffer(bytearray(words), np.uint8))
        put(mine.handle, mine.out[:1])
        process(theirs.handle, mine.out[0], message)
        fetch(mine.handle)
        busy(mine.bus)  # which only a side that waits calls
        receive(mine.handle, message)
        can_port(mine)


def _open_bus(role: Role, endpoint: str, options: CanOptions) -> Any:
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
        raise unusable(endpoint, "opened", said) from None


def _check_mtu(channel: str, fd: bool) -> None:
    """Check that a SocketCAN interface is set up for CAN FD; sending would fail too late."""
    with contextlib.suppress(OSError):
        mtu = int(Path(f"/sys/class/net/{channel}/mtu").read_text(encoding="ascii"))
        if fd and mtu < 72:
            raise ValueError("not set up for CAN FD (mtu 72); link.options.fd = false?")
