"""One client's connection: it checks frames strictly and answers requests one by one.

While pymodbus' own handler carries out a request, it keeps only the newest further one, and so
mixes up the answers to a client that does not wait. Here requests queue.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
import struct
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import SimDevice

from gfm_hil.core.identity import Identity, address
from gfm_hil.core.rate import Rate
from gfm_hil.ports.listener import Listener

UNIT = 1
_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), length of the rest, unit
_LONGEST = 1024  # of unit and PDU; the specification allows 254, longer ones get an error answer
_BUFFER = 64 * 1024
_MOST_WAITING = 32
_WRITE_ONE, _WRITE_MANY = 6, 16
_WRITES = (_WRITE_ONE, _WRITE_MANY)
_FUNCTIONS = (3, *_WRITES)

CLIENTS = 64  # most clients that have sent a request, and as many that have not yet
HALF_OPEN_S = 10.0  # timeout of a client's first request
IDLE_S = 300.0  # timeout of a silent client, except the one that commands
SEND_S = 5.0  # timeout of a client that does not read an answer
_PER_S, _BURST = 50.0, 100  # limit per client of requests that cause commands

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Client:
    """The identity of a client and its rate limit for commands."""

    identity: Identity
    rate: Rate


CLIENT: ContextVar[Client | None] = ContextVar("client", default=None)
"""The client whose request is being carried out; None if a timer caused the command."""

_Request = tuple[int, int, bytes]  # transaction, unit, PDU


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
        if unit != UNIT:
            return ExceptionResponse(code & 0x7F, ExcCodes.GATEWAY_NO_RESPONSE)
        if code not in _FUNCTIONS:
            return ExceptionResponse(code & 0x7F, ExcCodes.ILLEGAL_FUNCTION)
        request = self.framer.decoder.decode(frame)
        if request is None or (code != _WRITE_MANY and len(frame) != 5):
            return ExceptionResponse(code, ExcCodes.ILLEGAL_VALUE)
        answer = await request.datastore_update(self.server.context, UNIT)
        if code == _WRITE_ONE and not answer.isError():  # echo the request, not the new value
            answer.address, *answer.registers = struct.unpack(">HH", frame[1:])
        if code in _WRITES and not answer.isError():
            self.server.keep(self)
        return answer


class Server(ModbusTcpServer):
    """pymodbus' server with these connections.

    Args:
        device: the device to serve.
        address: host and port.
        tls: context that requires a certificate from clients; None: plain TCP.

    Raises:
        OSError: the address cannot be bound.
    """

    def __init__(
        self, device: SimDevice, address: tuple[str, int], tls: ssl.SSLContext | None
    ) -> None:
        super().__init__(device, address=address)
        self.peers = Listener(*address, CLIENTS, HALF_OPEN_S, IDLE_S)
        # TLS carries the same frames; pymodbus' own TLS server takes one per record instead
        self.call_create = partial(
            self.loop.create_server, self.handle_new_connection, sock=self.peers, ssl=tls
        )
        self.workers: set[asyncio.Task[None]] = set()
        self._commands: Connection | None = None

    def keep(self, connection: Connection) -> None:
        """Exempt the connection of the last client that commanded from the idle timeout."""
        if self._commands is not None:
            self.peers.keep(self._commands.number, kept=False)
        self._commands = connection
        self.peers.keep(connection.number)

    async def shutdown(self) -> None:
        """Close all connections."""
        await super().shutdown()
        for worker in self.workers:
            worker.cancel()
        await asyncio.gather(*self.workers, return_exceptions=True)

    def callback_new_connection(self) -> Connection:
        """Make the connection of a new client."""
        return Connection(self, self.trace_packet, self.trace_pdu, self.trace_connect)
