"""One client's connection: strict about frames, one request after the other.

pymodbus' own handler keeps only the newest request of a connection while one is being carried out,
which mixes up answers to a client that does not wait. Here they queue.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
import struct
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import SimDevice
from pymodbus.transport import CommParams, CommType

UNIT = 1
_HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), length of what follows it, unit
_LONGEST = 1024  # of unit and PDU; 254 by the specification, and what is longer hears so
_BUFFER = 64 * 1024
_MOST_WAITING = 32
_WRITE_ONE, _WRITE_MANY = 6, 16
_FUNCTIONS = (3, _WRITE_ONE, _WRITE_MANY)

_Request = tuple[int, int, bytes]  # transaction, unit, PDU


class Connection(ServerRequestHandler):
    """A connection of ``Server``."""

    def callback_connected(self) -> None:
        """Begin to answer."""
        super().callback_connected()
        self.max_buffer_size = _BUFFER  # pymodbus throws away what is beyond it
        self._waiting: asyncio.Queue[_Request | None] = asyncio.Queue()
        self.server.workers.add(asyncio.create_task(self._work()))

    def callback_disconnected(self, exc: Exception | None) -> None:
        """What was received is still carried out, what it said is not sent any more."""
        super().callback_disconnected(exc)
        self._waiting.put_nowait(None)

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Take whole requests; returns the bytes used. What is no Modbus ends the connection."""
        used = 0
        while len(data) - used >= _HEADER.size:
            transaction, protocol, length, unit = _HEADER.unpack_from(data, used)
            if protocol or not 2 <= length <= _LONGEST or self._waiting.qsize() >= _MOST_WAITING:
                self.close()
                return len(data)
            end = used + _HEADER.size - 1 + length
            if end > len(data):
                break
            self._waiting.put_nowait((transaction, unit, data[used + _HEADER.size : end]))
            used = end
        return used

    async def _work(self) -> None:
        """Answer one request after the other until the connection is closed."""
        while (request := await self._waiting.get()) is not None:
            transaction, unit, frame = request
            try:
                answer = await self._answer(unit, frame)
            except Exception:  # whatever it is, the client shall not wait for ever
                logging.getLogger(__name__).exception("request %s", frame.hex())
                answer = ExceptionResponse(frame[0] & 0x7F, ExcCodes.DEVICE_FAILURE)
            answer.transaction_id, answer.dev_id = transaction, unit
            if self.transport is not None:
                self.server_send(answer, None)
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
        if code == _WRITE_ONE and not answer.isError():  # an echo, whatever it reads afterwards
            answer.address, *answer.registers = struct.unpack(">HH", frame[1:])
        return answer


class Server(ModbusTcpServer):
    """pymodbus' server with these connections.

    Args:
        device: what it serves.
        address: host and port.
        tls: of a server that demands a certificate of its clients; None: plain TCP.
    """

    def __init__(
        self, device: SimDevice, address: tuple[str, int], tls: ssl.SSLContext | None
    ) -> None:
        if tls is not None:  # frames are the same: pymodbus' own for TLS takes one a record
            self.tls_setup = CommParams(
                comm_type=CommType.TLS, comm_name="server_listener", reconnect_delay=0.0,
                reconnect_delay_max=0.0, timeout_connect=0.0, sslctx=tls,
            )  # fmt: skip
        super().__init__(device, address=address)
        self.workers: set[asyncio.Task[None]] = set()

    async def shutdown(self) -> None:
        """Hang up on everybody."""
        await super().shutdown()
        for worker in self.workers:
            worker.cancel()
        await asyncio.gather(*self.workers, return_exceptions=True)

    @property
    def port(self) -> int:
        """Where it listens."""
        listening: Any = self.transport
        return int(listening.sockets[0].getsockname()[1])

    def callback_new_connection(self) -> Connection:
        """For a client that has connected."""
        return Connection(self, self.trace_packet, self.trace_pdu, self.trace_connect)
