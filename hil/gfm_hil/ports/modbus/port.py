"""A run as a SunSpec device on Modbus/TCP, as a port: it checks frames strictly, one by one.

While pymodbus' own handler carries out a request, it keeps only the newest further one, and so
mixes up the answers to a client that does not wait. Here requests queue.
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import ssl
import struct
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity, address
from gfm_hil.core.rate import Rate
from gfm_hil.core.supervised import supervised
from gfm_hil.ports.listener import Listener
from gfm_hil.ports.modbus.device import CLIENT, READ, TICK_S, WRITE_MANY, WRITE_ONE, Client, Device
from gfm_hil.ports.modbus.image import BASE, VENDOR, own_models
from gfm_hil.ports.modbus.measures import Watcher
from gfm_hil.ports.port import BesideRun, OperatorPort, make_tls, say
from gfm_hil.scenario import load_scenario

LOCAL = "modbus-local"  # in the run folder while the bench is commanded there
_POLL_S = 0.1  # poll interval of what changes rarely
_POLLS = 10  # such polls per update of the slack
_TIMER = Identity(through="modbus", name="timer")

MOST_UNITS = 247  # of Modbus; those of a network's converters count from 1, in their order
_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), length of the rest, unit
_LONGEST = 1024  # of unit and PDU; the specification allows 254, longer ones get an error answer
_BUFFER = 64 * 1024
_MOST_WAITING = 32

CLIENTS = 64  # most clients that have sent a request, and as many that have not yet
HALF_OPEN_S = 10.0  # timeout of a client's first request
IDLE_S = 300.0  # timeout of a silent client, except the one that commands
SEND_S = 5.0  # timeout of a client that does not read an answer
_PER_S, _BURST = 50.0, 100  # limit per client of requests that cause commands

_LOG = logging.getLogger(__name__)
_Request = tuple[int, int, bytes]  # transaction, unit, PDU


class ModbusPort(OperatorPort):
    """The SunSpec device of ``gfmhil modbus``."""

    risk = "and Modbus does not ask who commands"
    remedy = "use --tls CERT KEY CLIENT-CA, or --anyone-may-command"
    opens = (
        "--anyone-may-command",
        "listen without TLS: every client that reaches the port can command the bench",
    )
    commands = networks = True

    def options(self, command: argparse.ArgumentParser) -> None:
        folder = next(a for a in command._actions if a.dest == "folder")
        folder.nargs, folder.required = "?", False  # --vendor-model is of no run
        command.add_argument(
            "--tls", nargs=3, type=Path, metavar=("CERT", "KEY", "CLIENT-CA"),
            help="TLS with a certificate of ours, and one of every client, signed by CLIENT-CA",
        )  # fmt: skip
        command.add_argument(
            "--heartbeat", type=int, default=5000, metavar="MS",
            help="how long ControllerHb may stand still, 0: for ever (%(default)s)",
        )  # fmt: skip
        command.add_argument(
            "--control", choices=["local", "remote"],
            help="say whether clients may command, to the server of this run, and end",
        )  # fmt: skip
        command.add_argument(
            "--vendor-model", type=int, nargs="?", const=VENDOR, choices=sorted(own_models()),
            metavar="NUMBER", help="print the file of a model that SunSpec's own lack (%(const)s), "
            "and end",
        )  # fmt: skip

    def instead(self, options: argparse.Namespace) -> bool:
        if options.vendor_model is not None:
            print(own_models()[options.vendor_model].read_text(encoding="utf-8"), end="")
            return True
        if options.folder is None:
            raise UserError("RUN: missing; the run folder")
        if options.control is not None:
            if not options.folder.is_dir():
                raise UserError(f"{options.folder}: no such folder")
            flag = options.folder / LOCAL
            flag.touch() if options.control == "local" else flag.unlink(missing_ok=True)
        return options.control is not None

    def check(self, options: argparse.Namespace) -> None:
        if options.heartbeat < 0:
            raise UserError(f"--heartbeat {options.heartbeat}: must be >= 0 ms")
        if options.tls is not None:
            self.tls = make_tls(f"--tls {' '.join(map(str, options.tls))}", *options.tls)
        super().check(options)

    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        run.wait()
        logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # clients get the errors
        places = run.places
        if len(places) > MOST_UNITS:
            raise UserError(
                f"{run.folder}: {len(places)} converters: Modbus has {MOST_UNITS} units"
            )
        began = time.monotonic()
        served = [
            _make_device(run, place, unit, options.heartbeat, began)
            for unit, place in enumerate(places.values(), 1)
        ]
        devices, units = [device for device, _ in served], [*enumerate(places, 1)]

        async def serve() -> None:
            try:
                server = make_server(devices, (options.host, options.port), self.tls)
                await server.serve_forever(background=True)
            except (RuntimeError, OSError):
                where = f"--host {options.host} --port {options.port}"
                raise UserError(f"{where}: cannot listen there") from None
            try:
                kind = "Modbus/TCP with TLS" if self.tls else "Modbus/TCP"
                where = f"{options.host}:{server.peers.port}"
                named = (f"{unit} ({name})" if name else f"{unit}" for unit, name in units)
                say(f"{kind} on {where}, unit {', '.join(named)}, SunSpec from {BASE}")
                await asyncio.gather(
                    supervised("the clock of the Modbus server", lambda: tick(devices, began)),
                    supervised(
                        "the Modbus server's poll of the run",
                        lambda: watch(run.folder, served, server),
                    ),
                )
            finally:
                await server.shutdown()

        run.serve_until(serve())
        return 0


def _make_device(
    run: BesideRun, place: Path, unit: int, heartbeat_ms: int, began: float
) -> tuple[Device, Watcher]:
    """The device of one place of a run, and what it sees of it. Raises UserError: no run is in
    progress there."""
    operator = run.operator(place)
    scenario = load_scenario(str(place / "scenario.toml"))
    watcher = Watcher(operator, scenario.T_s)
    run.first(watcher.newest)

    def command(event: dict[str, Any]) -> None:
        client = CLIENT.get()
        by = _TIMER if client is None else client.identity
        if event["type"] == "stop":
            operator.stop(by)
        else:
            operator.command(event, by)
        watcher.forget()

    device = Device(
        scenario, operator.snapshot()["laws"], watcher.newest, command, heartbeat_ms,
        lambda: time.monotonic() - began, unit,
    )  # fmt: skip
    return device, watcher


def make_server(
    devices: Sequence[Device], address: tuple[str, int], tls: ssl.SSLContext | None = None
) -> Server:
    """The server of devices; raises OSError if the address cannot be bound."""
    return Server([_registers(device) for device in devices], address, tls)


def _registers(device: Device) -> SimDevice:
    """A device as pymodbus serves it."""

    async def action(
        code: int, first: int, at: int, count: int, registers: list[int], written: Any
    ) -> ExcCodes | None:
        refused = await device.access(at, written)
        image = device.image.registers
        registers[: len(image)] = image
        if written is not None:  # pymodbus writes them to its registers
            written[:] = image[at - first : at - first + count]
        return refused

    block = SimData(BASE, values=device.image.registers, datatype=DataType.REGISTERS)
    return SimDevice(id=device.unit, simdata=[block], action=action)


async def tick(devices: Sequence[Device], began: float) -> None:
    """Let the devices' clocks tick; one tick makes up for those that were missed."""
    k = 0
    while True:
        for device in devices:
            await device.clock()
        k = max(k + 1, int((time.monotonic() - began) / TICK_S))
        await asyncio.sleep(began + k * TICK_S - time.monotonic())


async def watch(folder: Path, served: Sequence[tuple[Device, Watcher]], server: Server) -> None:
    """Poll what changes rarely; the clock does not depend on it."""
    while True:
        for device, watcher in served:
            device.slack = watcher.slack()
        for _ in range(_POLLS):
            local = (folder / LOCAL).exists()
            for device, _watcher in served:
                device.take(local)
            server.peers.reap()
            await asyncio.sleep(_POLL_S)


class Connection(ServerRequestHandler):
    """A connection of ``Server``."""

    def callback_connected(self) -> None:
        """Start the task that answers."""
        super().callback_connected()
        self.max_buffer_size = _BUFFER  # pymodbus discards data beyond it
        self._waiting: asyncio.Queue[_Request | None] = asyncio.Queue()
        self._room = asyncio.Event()
        self._room.set()
        self.number = int(self.transport.get_extra_info("socket").fileno())
        self.server.workers.add(asyncio.create_task(self._work()))

    def _client(self) -> Client:
        """The client, as far as the connection identifies it."""
        peer = address(self.transport.get_extra_info("peername"))
        secure = self.transport.get_extra_info("ssl_object")
        subject = None if secure is None else secure.getpeercert()["subject"]
        name = subject and ", ".join(f"{key}={value}" for part in subject for key, value in part)
        who = Identity(through="modbus", peer=peer, certificate=name and name[:1000])
        return Client(who, Rate("this client", _PER_S, _BURST))

    def pause_writing(self) -> None:
        """Note that the client does not read its answers."""
        self._room.clear()

    def resume_writing(self) -> None:
        """Note that the client reads again."""
        self._room.set()

    def callback_disconnected(self, exc: Exception | None) -> None:
        """Carry out the requests received so far, without sending answers."""
        super().callback_disconnected(exc)
        self._waiting.put_nowait(None)

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Take whole requests; returns the bytes used. Invalid data closes the connection."""
        used = 0
        while len(data) - used >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(data, used)
            if self._waiting.qsize() >= _MOST_WAITING:  # it does not read its answers either
                self._drop()
                return len(data)
            if protocol or not 2 <= length <= _LONGEST:
                self.close()
                self._waiting.put_nowait(None)  # pymodbus does not report this end
                return len(data)
            end = used + _HEADER.size - 1 + length
            if end > len(data):
                break
            self._waiting.put_nowait((transaction, unit, data[used + _HEADER.size : end]))
            used = end
        if used:
            self.server.peers.heard(self.number)
        return used

    def _drop(self) -> None:
        """Abort the connection; discard unsent data."""
        transport: Any = self.transport
        if transport is not None:
            transport.abort()

    async def _work(self) -> None:
        """Answer one request after the other until the connection is closed."""
        CLIENT.set(client := self._client())
        while (request := await self._waiting.get()) is not None:
            transaction, unit, frame = request
            try:
                answer = await self._answer(unit, frame)
            except Exception:  # after any error, answer: the client must not wait for ever
                _LOG.exception("request %s", frame.hex())
                answer = ExceptionResponse(frame[0] & 0x7F, ExcCodes.DEVICE_FAILURE)
            answer.transaction_id, answer.dev_id = transaction, unit
            if self.transport is not None:
                self.server_send(answer, None)
            try:
                async with asyncio.timeout(SEND_S):
                    await self._room.wait()
            except TimeoutError:
                who = client.identity.peer
                _LOG.warning("%s: has taken nothing for %g s: the client is dropped", who, SEND_S)
                self._room.set()
                self._drop()
        self.server.workers.discard(asyncio.current_task())

    async def _answer(self, unit: int, frame: bytes) -> ModbusPDU:
        code = frame[0]
        if unit not in self.server.units:
            return ExceptionResponse(code & 0x7F, ExcCodes.GATEWAY_NO_RESPONSE)
        if code not in (READ, WRITE_ONE, WRITE_MANY):
            return ExceptionResponse(code & 0x7F, ExcCodes.ILLEGAL_FUNCTION)
        request = self.framer.decoder.decode(frame)
        if request is None or (code != WRITE_MANY and len(frame) != 5):
            return ExceptionResponse(code, ExcCodes.ILLEGAL_VALUE)
        answer = await request.datastore_update(self.server.context, unit)
        if code == WRITE_ONE and not answer.isError():  # echo the request, not the new value
            answer.address, *answer.registers = struct.unpack(">HH", frame[1:])
        if code != READ and not answer.isError():
            self.server.exempt(self)
        return answer


class Server(ModbusTcpServer):
    """pymodbus' server of devices at a host and port, with these connections.

    ``tls`` is a context that requires a certificate from clients; None: plain TCP. Raises OSError:
    the address cannot be bound.
    """

    def __init__(
        self, devices: list[SimDevice], address: tuple[str, int], tls: ssl.SSLContext | None
    ) -> None:
        super().__init__(devices, address=address)
        self.units = {device.id for device in devices}
        self.peers = Listener(*address, CLIENTS, HALF_OPEN_S, IDLE_S)
        # TLS carries the same frames; pymodbus' own TLS server takes one per record instead
        self.call_create = partial(
            self.loop.create_server, self.handle_new_connection, sock=self.peers, ssl=tls
        )
        self.workers: set[asyncio.Task[None]] = set()
        self._commands: Connection | None = None

    def exempt(self, connection: Connection) -> None:
        """Exempt the connection of the last client that commanded from the idle timeout."""
        if self._commands is not None:
            self.peers.exempt(self._commands.number, False)
        self._commands = connection
        self.peers.exempt(connection.number)

    async def shutdown(self) -> None:
        """Close all connections."""
        await super().shutdown()
        for worker in self.workers:
            worker.cancel()
        await asyncio.gather(*self.workers, return_exceptions=True)

    def callback_new_connection(self) -> Connection:
        """Make the connection of a new client."""
        return Connection(self, self.trace_packet, self.trace_pdu, self.trace_connect)
