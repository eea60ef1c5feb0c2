"""The serial link over pseudo terminals: framing, damage on the line, whole runs."""

import itertools
import os
import random
import select
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.core.errors import PeerLost, UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.engine.drive import end_exchange
from gfm_hil.links import link_kind, open_link
from gfm_hil.links.base import LONGEST
from gfm_hil.links.frame import FrameError, FrameReader, FrameWriter
from gfm_hil.links.serial import link as module
from gfm_hil.links.serial.framing import encoded
from gfm_runtime.signals import NY
from gfm_runtime.states import STOPPED

from ...support.links import PATIENT, Unstuffer, assert_same, run_pair


def unstuffed(line: bytes) -> list[bytes]:
    """The messages of a line."""
    into = Unstuffer()
    into.feed(line)
    return into.all()


KINDS = ("drop", "double", "wrong", "insert", "cut")


def damaged(line: bytes, kind: str, at: int, value: int) -> bytes:
    """A stuffed message with a fault somewhere before the zero that ends it."""
    at %= len(line) - 1
    wrong = bytes([line[at] ^ (value or 1)])
    return {
        "drop": line[:at] + line[at + 1 :],
        "double": line[:at] + line[at : at + 1] + line[at:],
        "wrong": line[:at] + wrong + line[at + 1 :],
        "insert": line[:at] + bytes([value]) + line[at:],
        "cut": line[:at] + b"\0",
    }[kind]


# The paper's examples (S. Cheshire and M. Baker), and those of the edges of a run of 254 bytes.
KNOWN = {
    "00": "01 01", "00 00": "01 01 01", "00 11 00": "01 02 11 01", "11 22 00 33": "03 11 22 02 33",
    "11 22 33 44": "05 11 22 33 44", "11 00 00 00": "02 11 01 01 01",
}  # fmt: skip


@pytest.mark.parametrize("plain", KNOWN)
def test_stuffing_is_that_of_the_literature(plain):
    assert encoded(bytes.fromhex(plain)) == bytes.fromhex(KNOWN[plain]) + b"\0"


def test_a_run_of_254_bytes_needs_one_more_byte():
    run = bytes(range(1, 255))
    assert encoded(b"\0" + run)[:2] == b"\x01\xff"
    assert encoded(run + b"\xff") == b"\xff" + run + b"\x02\xff\0"
    assert unstuffed(b"\xff" + run + b"\0") == [run]  # without a last code, as others leave it out


@given(st.binary(min_size=1, max_size=LONGEST))
def test_every_message_comes_back(message):
    line = encoded(message)
    assert line.count(0) == 1 and line[-1] == 0
    assert len(line) <= len(message) + 4 + 4
    assert unstuffed(line) == [message]


@given(
    st.lists(
        st.tuples(st.none() | st.sampled_from(KINDS), st.integers(0, 999), st.integers(0, 255)),
        min_size=1,
        max_size=12,
    ),
    st.lists(st.integers(1, 90), min_size=1, max_size=5),
)
def test_damage_costs_the_damaged_messages_alone(faults, cuts):
    """Every other frame arrives, in order; what comes of a damaged one, the reader refuses."""
    writer, line, good, traces = FrameWriter("y"), b"", [], 0
    for tick, (kind, at, value) in enumerate(faults):
        whole = encoded(writer.pack(tick, 2, 0, np.array([1.0, 0.0, tick, -0.0, 1 / 3])))
        one = whole if kind is None else damaged(whole, kind, at, value)
        if one.lstrip(b"\0") == whole:  # a zero more before a message ends nothing
            good.append(tick)
        else:
            traces += one != b"\0"
        line += one
    taken, reader, into, values = [], FrameReader("y"), Unstuffer(), np.zeros(5)
    refused, pieces, begin = 0, itertools.cycle(cuts), 0
    while begin < len(line):
        end = begin + next(pieces)
        into.feed(line[begin:end])
        begin = end
        for message in into.all():
            try:
                taken.append(reader.unpack(message, values))
            except FrameError:
                refused += 1
    assert taken == good
    assert refused + into.damaged >= traces
    assert refused + into.damaged == 0 or traces > 0


def test_a_lost_end_costs_two_messages_and_a_long_silence_of_zeros_none():
    into, words = Unstuffer(), [b"first", b"second", b"third", b"fourth"]
    line = encoded(words[0]) + encoded(words[1])[:-1] + encoded(words[2]) + encoded(words[3])
    into.feed(b"\x07ends somewhere\0" + line)
    found = into.all()
    assert found[0] == b"first" and found[-1] == b"fourth"
    assert b"second" not in found and b"third" not in found and into.damaged == 1
    into.feed(b"\x55" * 100_000)  # no end
    into.feed(b"\0" + encoded(b"again"))
    assert (into.all(), into.damaged) == ([b"again"], 2)


def test_a_damaged_greeting_is_left_out():
    """A frame has a CRC of its own; a digit of a greeting would change what it says."""
    hello = b'GFMHIL {"kind": "hello", "T_s": 0.0001}'
    into = Unstuffer()
    into.feed(encoded(hello).replace(b"0.0001", b"0.0002") + encoded(hello))
    assert (into.all(), into.damaged) == ([hello], 1)


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return link_kind("serial").fresh(tmp_path)


@pytest.mark.full
def test_a_run_with_an_inner_stage_has_the_bits_of_the_run_in_process(make, run, tmp_path):
    content = {"duration": 0.02, "link": PATIENT, "law": "vsg-2", "inner": "virtual-stator"}
    pair = run_pair(make(**content), tmp_path, "serial")
    assert_same(pair.signals, run(**content).signals)
    assert all(not any(counts.values()) for counts in pair.counters.values())
    assert all(not any(counts.values()) for counts in pair.faults.values())
    assert not (tmp_path / "line").is_symlink()


@contextmanager
def noisy_line(place: Path, noisy: Callable[[bytes], bytes]) -> Iterator[dict[Role, str]]:
    """Two pseudo terminals, and a thread that carries each message from one to the other as
    ``noisy`` makes it; the endpoint of each side."""
    ends, over = {}, threading.Event()
    with ExitStack() as stack:
        for role in ROLES:
            ours, theirs = os.openpty()
            tty.setraw(theirs)
            os.set_blocking(ours, False)
            stack.callback(os.close, ours)
            stack.callback(os.close, theirs)
            ends[role] = ours, f"serial://{os.ttyname(theirs)}"
        fds = [ends[role][0] for role in ROLES]

        def carry() -> None:
            rest = {fd: b"" for fd in fds}
            while not over.is_set():
                for fd in select.select(fds, [], [], 0.01)[0]:
                    *whole, rest[fd] = (rest[fd] + os.read(fd, 4096)).split(b"\0")
                    for message in whole:
                        os.write(fds[1 - fds.index(fd)], noisy(message + b"\0"))

        thread = threading.Thread(target=carry)
        thread.start()
        try:
            yield {role: path for role, (_, path) in ends.items()}
        finally:
            over.set()
            thread.join()


def test_damage_on_the_line_changes_no_bit(make, run, tmp_path):
    """Bytes that are lost, doubled, wrong or foreign: the plant asks again, and all is counted."""
    draw, hits = random.Random(1), dict.fromkeys(KINDS, 0)

    def noisy(line: bytes) -> bytes:
        if b"GFMHIL" in line or draw.random() > 0.2:
            return line
        kind = draw.choice(KINDS)
        worse = damaged(line, kind, draw.randrange(999), draw.randrange(256))
        hits[kind] += worse != line
        return worse

    content = {"duration": 0.02, "link": PATIENT, "law": "vsg-2"}
    with noisy_line(tmp_path, noisy) as path:
        pair = run_pair(make(**content), tmp_path, "serial", endpoint=path)
    assert_same(pair.signals, run(**content).signals)
    assert min(hits.values()) > 0
    ends = [pair.counters[role] | pair.faults[role] for role in ROLES]
    seen = sum(end[name] for end in ends for name in ("damaged_messages", "size", "crc"))
    lost = sum(end["lost"] for end in ends)
    assert seen > 0.7 * sum(hits.values())  # a message cut at its first byte leaves no trace
    assert 0.7 * sum(hits.values()) < lost <= sum(hits.values())
    assert not any(end[name] for end in ends for name in ("tick", "state", "source", "dropped"))


def test_a_line_is_of_one_side_and_of_one_user(endpoint, tmp_path, monkeypatch):
    controller = open_link("serial", "controller", endpoint)
    plant = open_link("serial", "plant", endpoint)
    try:
        with pytest.raises(UserError, match=r"line': cannot be made: File exists"):
            open_link("serial", "controller", endpoint)
        with pytest.raises(UserError, match=r"line': cannot be opened: "):
            open_link("serial", "plant", endpoint)
        monkeypatch.setattr(module.os, "geteuid", lambda: 12345)
        with pytest.raises(UserError, match="cannot be opened: it belongs to another user"):
            open_link("serial", "plant", endpoint)
        assert plant.send(b"\0a\0") and controller.wait(5) and controller.receive() == b"\0a\0"
    finally:
        plant.close()
        controller.close()
    with pytest.raises(UserError, match=r"/dev/none': cannot be opened: No such file"):
        open_link("serial", "plant", "serial:///dev/none")
    with pytest.raises(UserError, match=r"options.baud: .* than or equal to 1200, not 10"):
        open_link("serial", "plant", endpoint, {"baud": 10})


def test_the_sender_drops_what_the_line_cannot_take(endpoint):
    """The plant may ask again faster than the line is; then its queue must not grow."""
    controller = open_link("serial", "controller", endpoint)
    plant = open_link("serial", "plant", endpoint)
    try:
        sent = [plant.send(bytes([k % 256]) * LONGEST) for k in range(1000)]
        dropped = plant.counters["dropped"]
        assert dropped == sent.count(False) > 0
        came = []
        while controller.wait(0.2):
            while (message := controller.receive()) is not None:
                came.append(message)
            plant.receive()  # sends the rest of what was begun
        assert len(came) == sent.count(True) and {len(one) for one in came} == {LONGEST}
        assert controller.counters["damaged_messages"] == 0
    finally:
        plant.close()
        controller.close()


def test_a_line_whose_other_side_is_gone_is_a_lost_peer(endpoint):
    """Whatever call of the system finds out: at the end of a run PeerLost alone is expected."""
    controller = open_link("serial", "controller", endpoint)
    plant = open_link("serial", "plant", endpoint)
    assert plant.send(b"a") and controller.wait(5)
    controller.close()
    for _ in range(2):
        with pytest.raises(PeerLost, match=r"the serial line .*line is gone: Input/output"):
            plant.send(b"a")
    assert plant.receive() is None
    # at the end of a run: it closed once it had heard the first of several goodbyes
    end_exchange(plant, FrameWriter("y"), FrameReader("u"), 0, STOPPED, 0, np.zeros(NY))
    plant.close()
