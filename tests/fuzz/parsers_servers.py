"""The parsers of operators' input: Modbus requests, scope messages, commands to a side."""

import asyncio
import contextlib
import json
import logging
import socket
import struct
import threading
import time
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any

import zmq
from hypothesis import strategies as st
from pymodbus.simulator import DataType, SimData, SimDevice
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from gfm_hil.core.roles import ROLES
from gfm_hil.engine.announcement import announcement_file
from gfm_hil.engine.command_server import CommandServer
from gfm_hil.engine.setup import make_bench
from gfm_hil.engine.timeline import Timeline
from gfm_hil.ports.modbus.image import BASE, VENDOR
from gfm_hil.ports.modbus.port import Server
from gfm_hil.ports.scope import server as scope_server
from gfm_hil.ports.scope.recording import open_recording
from gfm_hil.ports.scope.session import Access
from gfm_hil.run.runner import run_scenario
from gfm_hil.scenario import check_scenario

from ..support.modbus_device import Bench as MadeUp
from ..support.processes import free_port
from ..support.xcp import (
    CONNECT,
    MASTER,
    MadeUpRun,
    datagram,
    download,
    set_mta,
    short_download,
    short_upload,
)
from ..support.xcp import slave as xcp_slave
from .conftest import Parser, Take
from .mutations import blobs, lines, texts
from .parsers_peers import SCENARIO

PATIENCE_S = 60.0


class Served:
    """A server in an event loop of a separate thread; collects the errors that it hides."""

    def __init__(self) -> None:
        self.loop, self.wrong = asyncio.new_event_loop(), list[str]()
        self.loop.set_exception_handler(lambda loop, about: self.wrong.append(str(about)))
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()
        self._handler = logging.Handler(logging.ERROR)
        self._handler.emit = lambda record: self.wrong.append(record.getMessage())  # type: ignore
        logging.getLogger().addHandler(self._handler)

    def call(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        """Run a coroutine in that loop."""
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(PATIENCE_S)

    def close(self) -> None:
        """Cancel what still runs, and stop the thread."""

        async def end() -> None:
            others = asyncio.all_tasks() - {asyncio.current_task()}
            for task in others:
                task.cancel()
            await asyncio.gather(*others, return_exceptions=True)

        self.call(end())
        logging.getLogger().removeHandler(self._handler)
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join()
        self.loop.close()

    def nothing_wrong(self) -> None:
        """Check that since the last call no error was logged and no task failed silently."""
        wrong, self.wrong[:] = list(self.wrong), []
        assert not wrong, wrong


@contextlib.contextmanager
def _modbus(place: Path) -> Iterator[Take]:
    served, device = Served(), MadeUp().device

    async def action(
        code: int, first: int, at: int, count: int, registers: list[int], written: Any
    ) -> Any:
        refused = await device.access(at, written)
        registers[: len(device.image.registers)] = device.image.registers
        if written is not None:
            written[:] = device.image.registers[at - first : at - first + count]
        return refused

    block = SimData(BASE, values=device.image.registers, datatype=DataType.REGISTERS)

    port = free_port()

    async def listen() -> Server:
        server = Server(
            [SimDevice(id=1, simdata=[block], action=action)], ("127.0.0.1", port), None
        )
        await server.serve_forever(background=True)
        return server

    server = served.call(listen())

    def ask(one: socket.socket, transaction: int) -> None:
        one.sendall(struct.pack(">HHHBBHH", transaction, 0, 6, 1, 3, BASE, 2))

    def answers(one: socket.socket, until: int) -> None:
        """Read whole answers until that of the transaction ``until``, or the connection's end."""
        seen = -1
        while seen != until:
            head = one.recv(7, socket.MSG_WAITALL)
            if not head:
                return
            seen, protocol, length, _ = struct.unpack(">HHHB", head)
            body = one.recv(length - 1, socket.MSG_WAITALL)
            assert protocol == 0 and 3 <= length <= 254 and len(body) == length - 1
            assert body[0] & 0x7F != 0 or body[0] == 0x80

    def take(message: bytes) -> None:
        with (
            socket.create_connection(("127.0.0.1", port), PATIENCE_S) as one,
            contextlib.suppress(ConnectionError, TimeoutError),
        ):
            one.sendall(message)
            ask(one, 0xFFFF)
            one.settimeout(0.05)  # an incomplete request gets no answer
            answers(one, 0xFFFF)
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as other:
            ask(other, 1)
            assert other.recv(13, socket.MSG_WAITALL)[9:] == b"SunS"
        served.nothing_wrong()

    try:
        yield take
    finally:
        served.call(server.shutdown())
        served.close()


def _requests() -> st.SearchStrategy[bytes]:
    points = MadeUp().device.image.points
    pdus = [struct.pack(">BHH", code, BASE, 2) for code in range(1, 7)]
    for path in ("704.WSetEna", "704.WSet", "715.ControllerHb", f"{VENDOR}.Law"):
        at, count = points[path].address, points[path].length
        pdus.append(struct.pack(">BHHB", 16, at, count, 2 * count) + bytes(2 * count))
        pdus.append(struct.pack(">BHH", 6, at, 1))
    pdus += [b"\x2b\x0e\x01\x00", b"\x17" + bytes(12), b"\x08\x00\x04\x00\x00", b"\x18\x00\x00"]
    framed = [struct.pack(">HHHB", k, 0, 1 + len(p), 1) + p for k, p in enumerate(pdus)]
    right = blobs(pdus).filter(len).map(lambda p: struct.pack(">HHHB", 7, 0, 1 + len(p), 1) + p)
    return st.lists(right | blobs(framed), min_size=1, max_size=4).map(b"".join)


@contextlib.contextmanager
def _scope(place: Path) -> Iterator[Take]:
    """An input is a page's messages, one per line; ``@token@`` stands for the token."""
    run = {"title": "f", "duration": 0.1, "law": "vsg-2", "link": {"type": "inproc"}}
    done = run_scenario(check_scenario(run, ""), place / "run")
    access, served, ports = Access(), Served(), list[int]()
    scope = scope_server.Scope([open_recording(done.folder)], access)
    pace, scope_server.FRAMES_PER_S = scope_server.FRAMES_PER_S, 500
    task = asyncio.run_coroutine_threadsafe(
        scope.serve("127.0.0.1", [0], None, ports.append), served.loop
    )
    while not ports:
        assert not task.done()
        time.sleep(0.01)
    hello = json.dumps({"kind": "hello", "token": access.tokens["operator"]})

    def take(script: bytes) -> None:
        with (
            connect(f"ws://127.0.0.1:{ports[0]}/socket") as page,
            contextlib.suppress(ConnectionClosed),
        ):
            for line in script.replace(b"@token@", access.tokens["operator"].encode()).split(b"\n"):
                page.send(line, text=True)
            page.send(hello)
            while True:
                said = page.recv(PATIENCE_S)
                if isinstance(said, str) and json.loads(said)["kind"] == "control":
                    break
            time.sleep(0.005)  # two pictures
        assert not task.done(), task.exception()
        served.nothing_wrong()

    try:
        yield take
    finally:
        scope_server.FRAMES_PER_S = pace
        task.cancel()
        served.close()


LOOKS = (
    {"kind": "look", "id": 3, "channels": ["p", "q"], "watched": ["V"], "bins": 64,
     "mode": "held", "span": 0.05, "start": 0.01},
    {"kind": "look", "id": 4, "channels": ["p"], "bins": 16, "mode": "roll", "span": 1.0},
    {"kind": "look", "id": 5, "channels": ["p"], "bins": 4096, "mode": "trigger", "span": 0.01,
     "trigger": {"channel": "p", "level": 0.5, "edge": "rising", "mode": "auto", "before": 0.2}},
    {"kind": "play", "start": 0.02, "speed": 0.1},
    {"kind": "command", "id": 7, "event": {"type": "reference", "P_ref": 0.6}},
    {"kind": "hello", "token": "@token@"},
)  # fmt: skip


@contextlib.contextmanager
def _commands(place: Path) -> Iterator[Take]:
    """An input is an operator's message, its parts separated by line ends."""
    context = zmq.Context()
    with contextlib.ExitStack() as stack:
        stack.callback(context.destroy, linger=0)
        loops = [stack.enter_context(_loop(place, role)) for role in ROLES]

        def take(message: bytes) -> None:
            for endpoint, stopped in loops:
                with context.socket(zmq.REQ) as operator:
                    operator.set(zmq.LINGER, 0)
                    operator.connect(endpoint)
                    operator.send_multipart(message.split(b"\n"))
                    assert operator.poll(PATIENCE_S * 1e3), "no answer"
                    answer = json.loads(operator.recv())
                    assert answer["ok"] or len(answer["error"]) < 20_000
                    wanted = b'"stop"' in message
                    assert not stopped or wanted
                    stopped.clear()

        yield take


@contextlib.contextmanager
def _loop(place: Path, role: Any) -> Iterator[tuple[str, list[bool]]]:
    """A command server whose loop only carries out commands; yields its place and the stops."""
    bench, stopped, bell, over = make_bench(SCENARIO), [], threading.Event(), threading.Event()
    timeline = Timeline(bench, place / f"events_{role}.jsonl", (role,))

    def work() -> None:
        for tick in range(2**40):
            bell.wait(0.1)
            bell.clear()
            timeline.carry_out(tick)
            if over.is_set():
                return

    thread = threading.Thread(target=work)
    thread.start()
    try:
        of = [(place, bench)], [timeline]
        with CommandServer(role, *of, bell.set, lambda: stopped.append(True)):
            found = json.loads(announcement_file(place, role).read_text())
            yield found["endpoint"], stopped
        assert thread.is_alive()
    finally:
        over.set()
        thread.join()
        timeline.close()


EVENTS = (
    {"type": "reference", "P_ref": 0.6, "ramp_s": 0.1},
    {"type": "law", "law": "mimo-gfm"},
    {"type": "gains", "values": {"D_p": 0.01}},
    {"type": "reset"},
    {"type": "grid-frequency", "f_hz": 49.9, "rate": 1.0},
    {"type": "grid-voltage", "V_g": 0.9, "duration": 0.1},
    {"type": "grid-phase-jump", "degrees": 10.0},
    {"type": "grid-impedance", "L_g": 2.0, "R_g": 1.0},
    {"type": "grid-breaker", "closed": True},
    {"type": "stop"},
)


def _jsons(many: tuple[dict[str, Any], ...]) -> st.SearchStrategy[bytes]:
    return texts([json.dumps(one) for one in many])


@contextlib.contextmanager
def _xcp(place: Path) -> Iterator[Take]:
    """An input is a datagram of XCP on UDP, to a slave that has a master."""

    def take(message: bytes) -> None:
        run = MadeUpRun()  # each command that comes must be an event
        slave = xcp_slave(run)
        slave.take(datagram(CONNECT), MASTER)
        answer = slave.take(message, MASTER)
        while answer:
            length, _ = struct.unpack_from("<HH", answer)
            packet, answer = answer[4 : 4 + length], answer[4 + length :]
            assert len(packet) == length and 1 <= length <= 255 and packet[0] in (0xFE, 0xFF)
            assert packet[0] == 0xFF or length == 2

    yield take


def _packets() -> st.SearchStrategy[bytes]:
    packets = [
        CONNECT, b"\xfe", b"\xfd", b"\xfc", b"\xfb", b"\xfa\x04", b"\xf5\x10", set_mta(0x8000),
        short_upload(0x1000, 64), short_download(0x8008, 0.5), short_download(0x9000, 1.0),
        short_download(0x11000, 0.01), download(1.0, 0.5), set_mta(0, extension=1),
    ]  # fmt: skip
    seeds = [datagram(packet) for packet in packets]
    return blobs([*seeds, datagram(set_mta(0x8000), download(1.0, 0.6), b"\xf5\x08")])


SERVERS = (
    Parser("modbus", _modbus, _requests),
    Parser("scope", _scope, lambda: lines(_jsons(LOOKS))),
    Parser("xcp", _xcp, _packets),
    Parser("commands", _commands, lambda: _jsons(EVENTS) | lines(_jsons(EVENTS))),
)
