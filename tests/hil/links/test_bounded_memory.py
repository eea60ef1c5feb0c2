"""A peer's messages take no more memory than the longest valid message."""

import contextlib
import json
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zmq

from gfm_hil.links.base import LONGEST
from gfm_hil.ports.streams import messages as blocks
from gfm_hil.recording.columns import SIGNALS_OF, TIMES_OF

pytestmark = pytest.mark.processes

BIG = 50_000_000  # bytes
LOOSE_KB = 20_000  # far less than one big message
PATIENCE_S = 60

Child = Callable[[str], "subprocess.Popen[str]"]


@pytest.fixture
def child(spawn) -> Child:
    """Run a program that prints ``ready`` and its endpoint, and then waits for its end."""
    return lambda program: spawn("-c", program)


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def peak_kb(process: subprocess.Popen[str]) -> int:
    """Peak memory of a process, kB."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0])


def flood(kind: int, endpoint: str, message: bytes, times: int, *, bind: bool = False) -> int:
    """Send a message until the peer has disconnected ``times`` times; returns how often it did."""
    with zmq.Context() as context, context.socket(kind) as attacker:
        attacker.set(zmq.LINGER, 0)
        attacker.set(zmq.SNDTIMEO, 100)
        attacker.set(zmq.RECONNECT_IVL, 10)
        monitor = attacker.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        parted = 0
        if bind:
            attacker.bind(endpoint)
        else:
            attacker.connect(endpoint)
        until = time.monotonic() + PATIENCE_S
        while parted < times and time.monotonic() < until:
            with contextlib.suppress(zmq.Again):
                attacker.send(message)
            if monitor.poll(100):
                monitor.recv_multipart()
                parted += 1
        attacker.disable_monitor()
        monitor.close(linger=0)
    return parted


def subscribe(port: int, topic: bytes) -> bool:
    """Subscribe by ZMTP 3.0, without a libzmq that would store the topic; returns whether the peer
    closed the connection."""
    signature = b"\xff" + bytes(8) + b"\x7f"
    greeting = signature + b"\3\0" + b"NULL".ljust(20, b"\0") + bytes(32)
    ready = b"\5READY" + b"\x0bSocket-Type" + (3).to_bytes(4, "big") + b"SUB"
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as attacker:
        attacker.sendall(greeting + bytes([4, len(ready)]) + ready)
        message = b"\1" + topic
        try:
            attacker.sendall(b"\2" + len(message).to_bytes(8, "big") + message)
            while attacker.recv(4096):
                pass
        except ConnectionError:
            return True
        except TimeoutError:
            return False
    return True


LINK = """
from gfm_hil.links import open_link
link = open_link("zmq", "controller", {endpoint!r}, {{"portable": {portable}}})
print("ready", flush=True)
while True:
    link.wait(1)
    if link.receive() == b"good":
        print("good", flush=True)
"""


@pytest.mark.parametrize("portable", [False, True])
@pytest.mark.attack("6.1", "a peer of the link sends messages of 50 MB", "787 MB for 200 MB frames")
def test_a_long_message_costs_a_link_nothing(portable, child, endpoint, attack_now):
    process = child(LINK.format(endpoint=endpoint, portable=portable))
    assert line(process) == "ready"
    before = peak_kb(process)
    assert flood(zmq.PAIR, endpoint, bytes(BIG), times=2) == 2
    grown = peak_kb(process) - before
    assert grown < LOOSE_KB
    with zmq.Context() as context, context.socket(zmq.PAIR) as peer:
        peer.connect(endpoint)
        peer.send(b"good")
        assert line(process) == "good"  # the place is free again
    attack_now(f"libzmq parts with the peer; peak memory grew by {grown / 1000:.0f} MB")


def test_the_longest_message_gets_through_encrypted(tmp_path):
    from gfm_hil.links import open_link
    from gfm_hil.links.zeromq.curve import write_keys

    write_keys(tmp_path)
    with zmq.Context() as context, context.socket(zmq.PAIR) as probe:
        port = probe.bind_to_random_port("tcp://127.0.0.1")
    where, options = f"tcp://127.0.0.1:{port}", {"curve": str(tmp_path)}
    controller = open_link("zmq", "controller", where, options)
    plant = open_link("zmq", "plant", where, options)
    try:
        assert plant.send(bytes(LONGEST))
        assert controller.wait(30)
        assert controller.receive() == bytes(LONGEST)
        assert not plant.send(bytes(LONGEST + 1))
    finally:
        plant.close()
        controller.close()


PUBLISHER = """
import sys, time
from gfm_hil.ports.streams.port import Publisher
with Publisher("127.0.0.1", 0, 0) as publisher:
    print(publisher.samples, publisher.blocks, flush=True)
    while True:
        publisher._samples.send(b"x")
        publisher._blocks.send(b"x")
        time.sleep(0.01)
"""


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.attack(
    "6.2", "a subscription of 50 MB at gfmhil stream", "past 11 GB for one of 100 MB"
)
def test_a_long_subscription_costs_the_stream_nothing(which, child, attack_now):
    process = child(PUBLISHER)
    where = line(process).split()[which]
    before = peak_kb(process)
    for _ in range(2):
        assert subscribe(int(where.rpartition(":")[2]), bytes(BIG))
    grown = peak_kb(process) - before
    assert grown < LOOSE_KB
    with zmq.Context() as context, context.socket(zmq.SUB) as subscriber:
        subscriber.subscribe(b"")
        subscriber.connect(where)
        assert subscriber.poll(PATIENCE_S * 1000)
        assert subscriber.recv() == b"x"
    attack_now(f"the subscriber is turned away; peak memory grew by {grown / 1000:.0f} MB")


READER = """
import sys
from gfm_hil.ports.streams import BlockReader
with BlockReader({where!r}) as reader:
    print("ready", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def reader(child) -> tuple[subprocess.Popen[str], str]:
    """A reader that does not read, and the endpoint that it connects to."""
    with zmq.Context() as context, context.socket(zmq.PAIR) as probe:
        where = f"tcp://127.0.0.1:{probe.bind_to_random_port('tcp://127.0.0.1')}"
    process = child(READER.format(where=where))
    assert line(process) == "ready"
    return process, where


@pytest.mark.attack("6.3", "a stream sends a block of 50 MB to a reader", "it was kept")
def test_a_long_block_costs_a_reader_nothing(reader, attack_now):
    process, where = reader
    before = peak_kb(process)
    assert flood(zmq.PUB, where, b"gfmhil/plant" + bytes(BIG), times=1, bind=True) == 1
    grown = peak_kb(process) - before
    assert grown < LOOSE_KB
    attack_now(f"the reader parts with the stream; peak memory grew by {grown / 1000:.0f} MB")


@pytest.mark.attack("6.4", "a stream sends blocks to a reader that does not read", "all were kept")
def test_what_waits_for_a_reader_is_bounded(reader, attack_now):
    process, where = reader
    before = peak_kb(process)
    sent, taken, block = 40 * blocks.ROOM, 0, bytes(10_000)  # 200 MB
    with zmq.Context() as context, context.socket(zmq.XPUB) as attacker:
        attacker.set(zmq.LINGER, 0)
        attacker.set(zmq.SNDHWM, 10)
        attacker.set(zmq.SNDTIMEO, 1000)
        attacker.set(zmq.XPUB_NODROP, 1)
        attacker.bind(where)
        assert attacker.poll(PATIENCE_S * 1000)
        with contextlib.suppress(zmq.Again):
            while taken < sent:
                attacker.send_multipart([b"gfmhil/plant", block])
                taken += 1
    kept = peak_kb(process) - before
    assert taken < sent
    assert kept < 4 * blocks.ROOM * len(block) / 1000 + LOOSE_KB
    attack_now(f"{taken} of {sent} blocks of 10 kB were taken: {kept / 1000:.0f} MB")


def test_the_largest_block_gets_through():
    rows = blocks.NewRows("plant", 0, np.ones((5000, len(SIGNALS_OF["plant"]))),
                       np.zeros((5000, len(TIMES_OF["plant"])), np.int64))  # fmt: skip
    (message,) = blocks.block_messages(rows)
    with zmq.Context() as context, context.socket(zmq.PUB) as sender:
        port = sender.bind_to_random_port("tcp://127.0.0.1")
        with blocks.BlockReader(f"tcp://127.0.0.1:{port}") as reader:
            block = None
            until = time.monotonic() + PATIENCE_S
            while block is None and time.monotonic() < until:
                sender.send_multipart(message)
                block = reader.receive(0.1)
    assert block is not None
    assert len(block.rows) == 5000


OPERATOR = """
import sys
from pathlib import Path
from gfm_hil.core.errors import UserError
from gfm_hil.ports import commands as client
client._ANSWER_MS = 1000
operator = client.Operator(Path({folder!r}))
print("ready", flush=True)
try:
    operator.command({{"type": "reset"}})
except UserError as problem:
    print(problem, flush=True)
sys.stdin.readline()
"""


@pytest.mark.attack("6.5", "a side answers an operator with 50 MB", "it was read whole")
def test_a_long_answer_costs_an_operator_nothing(child, tmp_path, attack_now):
    from gfm_hil.core import temporary as scratch

    with scratch.temporary("gfmhil-commands-") as place:
        announced = {"endpoint": f"ipc://{place}/controller"}
        (tmp_path / "commands_controller.json").write_text(json.dumps(announced), encoding="utf-8")
        with zmq.Context() as context, context.socket(zmq.REP) as server:
            server.set(zmq.LINGER, 0)
            server.bind(announced["endpoint"])
            process = child(OPERATOR.format(folder=str(tmp_path)))
            assert line(process) == "ready"
            before = peak_kb(process)
            assert server.poll(PATIENCE_S * 1000)
            server.recv()
            server.send(bytes(BIG))
            said = line(process)
    grown = peak_kb(process) - before
    assert said == f"{tmp_path}: the controller does not answer"
    assert grown < LOOSE_KB
    attack_now(f"refused as no answer; peak memory grew by {grown / 1000:.0f} MB")
