"""The Modbus server among many clients: silent, half-open and flooding ones."""

import asyncio
import errno
import resource
import socket
import struct
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from functools import partial
from typing import Any

import pytest
from pymodbus.constants import ExcCodes

from gfm_hil.core.errors import UserError
from gfm_hil.core.stopping import Interrupt
from gfm_hil.core.supervised import supervised
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.modbus import port as connection
from gfm_hil.ports.modbus.image import VENDOR
from gfm_hil.ports.modbus.port import CLIENTS, Server, make_server, tick
from gfm_hil.ports.port import BesideRun

from ...support.modbus import SUNS
from ...support.modbus_device import Bench

pytestmark = pytest.mark.processes

PATIENCE_S = 60.0
READ = struct.pack(">BHH", 3, SUNS, 2)
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def frame(pdu: bytes) -> bytes:
    return struct.pack(">HHHB", 1, 0, len(pdu) + 1, 1) + pdu


def write_law(bench: Bench, law: int) -> bytes:
    return struct.pack(">BHH", 6, bench.device.image.points[f"{VENDOR}.Law"].address, law)


async def ask(streams: Streams, pdu: bytes) -> bytes:
    """Send one request; returns the answer."""
    reader, writer = streams
    writer.write(frame(pdu))
    async with asyncio.timeout(PATIENCE_S):
        length = struct.unpack(">HHHB", await reader.readexactly(7))[2]
        return await reader.readexactly(length - 1)


async def ended(streams: Streams) -> bool:
    """Whether the server has disconnected; discards what it sent before."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            while await streams[0].read(65536):
                pass
    except ConnectionError:
        return True
    return True


@asynccontextmanager
async def served(bench: Bench):
    """A server of a simulated run; connects a client at each call."""
    server = make_server([bench.device], ("127.0.0.1", 0))
    await server.serve_forever(background=True)
    async with AsyncExitStack() as stack:

        async def connect() -> Streams:
            streams = await asyncio.open_connection("127.0.0.1", server.peers.port)
            stack.callback(streams[1].close)
            return streams

        try:
            yield server, connect
        finally:
            await server.shutdown()


def among(work: Callable[[Bench, Server, Callable[[], Awaitable[Streams]]], Awaitable[Any]]) -> Any:
    """Run a test's coroutine with a server."""

    async def call() -> Any:
        bench = Bench()
        async with served(bench) as (server, connect):
            return await work(bench, server, connect)

    return asyncio.run(call())


@pytest.mark.attack(
    "4.5", "600 half-open connections beside one that commands and one that reads",
    "each takes a descriptor until there is none",
)  # fmt: skip
def test_half_open_connections_take_no_place_from_those_that_speak(attack_now):
    async def work(bench: Bench, server: Server, connect: Any) -> int:
        commander, reader = await connect(), await connect()
        assert await ask(commander, write_law(bench, 2)) == write_law(bench, 2)
        assert (await ask(reader, READ))[0] == 3
        silent = [await connect() for _ in range(600)]
        for streams in silent[: 600 - CLIENTS]:
            assert await ended(streams)
        assert await ask(commander, write_law(bench, 1)) == write_law(bench, 1)
        assert (await ask(reader, READ))[0] == 3
        return len(server.active_connections)

    count = among(work)
    assert count <= CLIENTS + 2
    attack_now(f"{count} of 602 connections are left, both clients among them")


@pytest.mark.attack(
    "4.6", "200 clients that read once and then stay", "each takes a descriptor for good"
)
def test_the_most_silent_client_makes_room_but_not_the_one_that_commands(attack_now):
    async def work(bench: Bench, server: Server, connect: Any) -> int:
        commander = await connect()
        assert await ask(commander, write_law(bench, 2)) == write_law(bench, 2)
        clients = []
        for _ in range(200):
            clients.append(await connect())
            assert (await ask(clients[-1], READ))[0] == 3
        for streams in clients[: 200 - CLIENTS]:
            assert await ended(streams)
        assert (await ask(clients[-1], READ))[0] == 3
        assert await ask(commander, write_law(bench, 1)) == write_law(bench, 1)
        return len(server.active_connections)

    count = among(work)
    assert count <= CLIENTS + 1
    attack_now(f"{count} of 201 are left, the one that commands among them")


def test_silent_connections_end_by_themselves(monkeypatch):
    monkeypatch.setattr(connection, "HALF_OPEN_S", 0.2)
    monkeypatch.setattr(connection, "IDLE_S", 0.2)

    async def work(bench: Bench, server: Server, connect: Any) -> None:
        commander, reader, silent = [await connect() for _ in range(3)]
        await ask(commander, write_law(bench, 2))
        await ask(reader, READ)
        await asyncio.sleep(0.3)
        server.peers.reap()
        assert await ended(reader) and await ended(silent)
        assert await ask(commander, write_law(bench, 1)) == write_law(bench, 1)

    among(work)


@pytest.mark.attack(
    "4.7", "a Modbus client that asks without end and reads no answer",
    "answers pile up in the server's memory without end",
)  # fmt: skip
def test_a_client_that_never_reads_is_dropped(monkeypatch, caplog, attack_now):
    monkeypatch.setattr(connection, "SEND_S", 0.3)

    async def work(bench: Bench, server: Server, connect: Any) -> None:
        reader, writer = await connect()
        other = await connect()
        reader._transport.pause_reading()
        question = frame(struct.pack(">BHH", 3, SUNS, 125))
        mine = next(iter(server.active_connections.values()))
        async with asyncio.timeout(PATIENCE_S):
            while mine._room.is_set():
                writer.write(question * 8)
                while mine._waiting.qsize() and mine._room.is_set():
                    await asyncio.sleep(0)
                await asyncio.sleep(0)
            assert (await ask(other, READ))[0] == 3
            while len(server.workers) > 1:  # until only the other client's is left
                await asyncio.sleep(0.01)

    among(work)
    assert "has taken nothing" in caplog.text
    attack_now("dropped, nothing of it stays; the other client is answered")


def test_nothing_stays_of_a_client_that_speaks_no_modbus():
    async def work(bench: Bench, server: Server, connect: Any) -> None:
        for _ in range(5):
            streams = await connect()
            streams[1].write(b"GET / HTTP/1.1\r\n\r\n")
            assert await ended(streams)
        async with asyncio.timeout(PATIENCE_S):
            while server.workers:
                await asyncio.sleep(0.01)

    among(work)


@pytest.mark.attack("10.5", "500 writes at once from one Modbus client", "500 commands carried out")
def test_a_client_has_a_limit_of_commands(monkeypatch, attack_now):
    standing = partial(connection.Rate, clock=lambda: 0.0)  # on a machine of any speed
    monkeypatch.setattr(connection, "Rate", standing)

    async def work(bench: Bench, server: Server, connect: Any) -> None:
        streams = await connect()
        answers = [await ask(streams, write_law(bench, 1 + k % 2)) for k in range(500)]
        busy = bytes((6 | 0x80, ExcCodes.DEVICE_BUSY))
        refused = answers.count(busy)
        assert busy not in answers[: connection._BURST] and refused == 500 - connection._BURST
        assert len(bench.told) == 500 - refused
        assert f"{refused} refused" in bench.read(f"{VENDOR}.Refd")
        stop = struct.pack(">BHH", 6, bench.device.image.points["715.OpCtl"].address, 0)
        assert await ask(streams, write_law(bench, 1)) == busy
        assert await ask(streams, stop) == stop
        assert bench.told[-1] == {"type": "stop"}
        attack_now(f"{500 - refused} carried out, {refused} refused with exception 6; stop passes")

    among(work)


@pytest.mark.attack(
    "4.8", "the look at the run and the clock of the Modbus server raise EMFILE",
    "the server ends as if the run were over",
)  # fmt: skip
def test_the_server_outlives_its_own_exceptions(monkeypatch, caplog, tmp_path, attack_now):
    for where in ("core.supervised.PAUSE_S", "ports.port.PAUSE_S", "ports.port._POLL_S"):
        monkeypatch.setattr(f"gfm_hil.{where}", 0.01)
    full = OSError(errno.EMFILE, "Too many open files")
    failures = {"clock": [full] * 3, "look": [UserError("Too many open files"), full]}
    seen = {"clock": 0, "look": 0}

    def look(name: str) -> list[str]:
        if failures[name]:
            raise failures[name].pop()
        seen[name] += 1
        return ["plant"] if min(seen.values()) < 5 else []  # until both have worked again

    class Stub:
        async def clock(self) -> None:
            look("clock")

    monkeypatch.setattr("gfm_hil.ports.port.running_roles", lambda folder: look("look"))
    with Interrupt() as interrupt, BesideRun(tmp_path, "modbus", False, interrupt) as run:
        run.serve_until(supervised("the clock", lambda: tick([Stub()], time.monotonic())))
    assert caplog.text.count("Too many open files") == 5
    attack_now("5 of 5 reported; clock and look go on to the end of the run")


def test_a_listener_takes_a_quarter_of_the_descriptors_at_most(monkeypatch):
    monkeypatch.setattr(resource, "getrlimit", lambda what: (20, 20))
    with Listener("127.0.0.1", 0, 64, 10.0, 10.0) as listener, ExitStack() as stack:
        listener.listen()
        for _ in range(7):
            peer = stack.enter_context(socket.create_connection(listener.getsockname()))
            stack.enter_context(listener.accept()[0])
        assert len(listener._peers) == 5
        peer.sendall(b"x")
    with pytest.raises(OSError, match="in use"):
        port = stack.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1]
        Listener("127.0.0.1", port, 64, 10.0, 10.0)
