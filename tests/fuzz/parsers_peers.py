"""The parsers of messages from the other side: frames, handshake, CAN."""

import contextlib
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from hypothesis import strategies as st

from gfm_hil.core.errors import PeerLost
from gfm_hil.core.roles import ROLES
from gfm_hil.engine.handshake import _what_runs, shake_hands
from gfm_hil.links.base import LONGEST
from gfm_hil.links.can import CanOptions
from gfm_hil.links.can.dbc import read_dbc, write_dbc
from gfm_hil.links.can.layout import plan_of
from gfm_hil.links.can.node import TRANSPORT, Node, process
from gfm_hil.links.can.vectors import VectorSender
from gfm_hil.links.can.wire import MOST, frame_dtype
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_hil.links.serial.framing import encoded
from gfm_hil.scenario import check_scenario
from gfm_runtime.signals import NU, NY

from ..support.links import Unstuffer
from .conftest import Parser, Take
from .mutations import blobs, lines, texts

SCENARIO = check_scenario(
    {
        "title": "fuzz", "duration": 0.1, "law": "vsg-2", "after_trip": "wait",
        "ready_laws": ["mimo-gfm"],
        "link": {"type": "shm", "start_timeout_s": 60.0, "peer_timeout_s": 60.0},
    },
    "fuzz",
)  # fmt: skip
Y = np.arange(NY, dtype=float)


@contextlib.contextmanager
def _frames(place: Path) -> Iterator[Take]:
    def take(message: bytes) -> None:
        for group, count in (("y", NY), ("u", NU)):
            for sealed in (message, message[:-4] + struct.pack("<I", zlib.crc32(message[:-4]))):
                reader, values = FrameReader(group), np.full(count, 7.0)
                try:
                    tick = reader.unpack(sealed, values)
                except FrameError:
                    assert (values == 7.0).all()
                    assert sum(reader.faults.values()) == 1
                else:
                    assert len(sealed) == 24 + 8 * count and 0 <= tick < 2**63
                    assert zlib.crc32(sealed[:-4]).to_bytes(4, "little") == sealed[-4:]
                    assert values.tobytes() == sealed[20:-4]

    yield take


def _frame_seeds() -> list[bytes]:
    return [FrameWriter("y").pack(3, 2, 0, Y), FrameWriter("u").pack(3, 2, 0, Y[:NU])]


class Liar:
    """The end of a link whose peer sends arbitrary messages."""

    port = None

    def __init__(self, messages: list[bytes]) -> None:
        self.messages = messages

    def send(self, message: bytes) -> bool:
        return True

    def receive(self) -> bytes | None:
        return self.messages.pop(0) if self.messages else None

    def wait(self, seconds: float) -> bool:
        return bool(self.messages)

    def close(self) -> None:
        """Do nothing: there are no resources."""


@contextlib.contextmanager
def _handshake(place: Path) -> Iterator[Take]:
    """An input is the peer's messages, one per line; ``@name@`` stands for our value."""
    ours = {f"@{k}@".encode(): str(v).encode() for k, v in _what_runs(SCENARIO).items()}

    def take(script: bytes) -> None:
        for name, value in ours.items():
            script = script.replace(name, value)
        for role in ROLES:
            link, said, now = Liar(script.split(b"\n")), [], time.monotonic_ns()
            try:
                start = shake_hands(
                    role, link, SCENARIO, lambda link=link: not link.messages, said.append
                )
                assert abs(start.t0_ns - now) < 24 * 3600e9
            except PeerLost as problem:
                said.append(str(problem))
            assert all(text.isprintable() and len(text) < 2000 for text in said), said

    yield take


def _hellos() -> st.SearchStrategy[bytes]:
    fit = '"version": @version@, "table": "@table@", "T_s": @T_s@, "laws": "@laws@"'
    both = [
        f'GFMHIL {{"role": "{role}", "boot": "b", {fit}, "digest": "@digest@", "kind": "hello"}}'
        for role in ROLES
    ]
    start = 'GFMHIL {"kind": "start", "t0": 123456789}'
    whole = st.sampled_from([text.encode() for text in (*both, start)])
    return lines(whole | texts([*both, start]) | blobs(_frame_seeds()))


@contextlib.contextmanager
def _can(place: Path) -> Iterator[Take]:
    """An input is a sequence of frames: identifier (4 bytes), length (1), data (64)."""
    plans = {fd: plan_of(read_dbc(write_dbc(fd))) for fd in (True, False)}

    def take(content: bytes) -> None:
        for fd, role in ((True, "controller"), (False, "plant")):
            node = Node(plans[fd], role, CanOptions(fd=fd))
            untouched = [part.copy() for part in (node.sender, node.sockets, node.out)]
            room = np.full(MOST + 128, 0xA5, np.uint8)
            reader = FrameReader("y" if role == "controller" else "u")
            values = np.empty(NY if role == "controller" else NU)
            for at in range(0, len(content), 69):
                frame, piece = np.zeros(1, frame_dtype), content[at : at + 69].ljust(69, b"\0")
                frame["id"], frame["length"] = struct.unpack("<IB", piece[:5])
                frame["length"] %= 65  # no kernel delivers more
                frame["data"] = np.frombuffer(piece[5:], np.uint8)
                size = process(node.handle, frame[0], room[64:-64])
                assert TRANSPORT <= size <= MOST
                if size > 0:
                    with contextlib.suppress(FrameError):
                        reader.unpack(room[64 : 64 + size].tobytes(), values)
                assert (room[:64] == 0xA5).all() and (room[-64:] == 0xA5).all()
            after = [node.sender, node.sockets, node.out]
            assert all(a.tobytes() == b.tobytes() for a, b in zip(untouched, after, strict=True))

    yield take


def _can_seeds() -> list[bytes]:
    seeds = []
    for fd, role, group, values in ((True, "plant", "y", Y), (False, "controller", "u", Y[:NU])):
        plan = plan_of(read_dbc(write_dbc(fd)))
        sender, writer = VectorSender(plan, group, 3), FrameWriter(group)
        frames = [f for k in range(4) for f in sender.frames(writer.pack(k, 2, 0, values))]
        frames.append((plan.transport[role], b"\x07GFMHIL "))
        seeds.append(b"".join(struct.pack("<IB64s", n, len(d), d) for n, d in frames))
    return seeds


@contextlib.contextmanager
def _serial(place: Path) -> Iterator[Take]:
    """Bytes of a line: no message is too long, and the next one arrives after any of them."""

    def take(content: bytes) -> None:
        into, found = Unstuffer(), []
        for piece in (content[:7], content[7:], b"\0" + encoded(b"next")):
            into.feed(piece)
            while (message := into.next()) is not None:
                found.append(message)
        assert found[-1] == b"next" and max(map(len, found)) <= LONGEST
        assert len(found) + into.damaged <= content.count(b"\0") + 2

    yield take


def _serial_seeds() -> list[bytes]:
    writer = FrameWriter("y")
    frames = [encoded(writer.pack(k, 2, 0, Y)) for k in range(3)]
    greeting = b'GFMHIL {"kind": "hello", "role": "plant"}'
    return [b"".join(frames), encoded(greeting), encoded(bytes(range(1, 256)) + bytes(249))]


PEERS = (
    Parser("frames", _frames, lambda: blobs(_frame_seeds())),
    Parser("handshake", _handshake, _hellos),
    Parser("can", _can, lambda: blobs(_can_seeds(), changes=12)),
    Parser("serial", _serial, lambda: blobs(_serial_seeds(), changes=12)),
)
