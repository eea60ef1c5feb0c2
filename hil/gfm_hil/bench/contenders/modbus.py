"""Modbus/TCP, by the package pymodbus."""

import asyncio
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from gfm_hil.bench.contenders import Contender, PackageEnd, free_port, server_end
from gfm_hil.bench.contenders.ours import UDP
from gfm_hil.bench.pingpong import Messages, PingPong
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role

_MOST = 121  # registers that function 23 may write


def contenders(folder: Path) -> Iterator[Contender]:
    port = str(free_port())
    yield Contender("modbus tcp", "modbus", port, _open, "pymodbus", limit=UDP)


def _open(c: Contender, role: Role, own: Messages) -> PingPong | PackageEnd:
    """The controller is the server. A request of the plant writes y and reads u at once (function
    23), as registers of 16 bits; both have the size of y."""
    if not 2 <= own.shape[1] <= 2 * _MOST:
        raise UserError(f"a Modbus message holds 2 to {2 * _MOST} bytes")
    return (_server if role == "controller" else _Client)(int(c.endpoint))


class _Client(PackageEnd):
    """The plant's end: it sends a request and has the answer before it polls for one."""

    def __init__(self, port: int) -> None:
        from pymodbus.client import ModbusTcpClient

        super().__init__()
        self._client = ModbusTcpClient("127.0.0.1", port=port, timeout=1.0, retries=0)
        if not self._client.connect():
            raise UserError(f"no Modbus server at port {port}")
        self.close = self._client.close

    def send(self, message: bytes) -> None:
        values = np.frombuffer(message[: len(message) // 2 * 2], ">u2").tolist()
        answer = self._client.readwrite_registers(
            read_address=0, read_count=len(values), write_address=_MOST, values=values
        )
        if not answer.isError():
            self.arrived.append(struct.pack(f">{len(values)}H", *answer.registers))


def _server(port: int) -> PingPong:
    """A server that answers in a thread of its own."""
    from pymodbus.server import ModbusTcpServer
    from pymodbus.simulator import DataType, SimData, SimDevice

    loop = asyncio.new_event_loop()

    async def start() -> Any:
        registers = SimData(0, count=2 * _MOST, values=0, datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(1, simdata=[registers]), address=("127.0.0.1", port))
        await server.serve_forever(background=True)
        return server

    server = loop.run_until_complete(start())
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    def close() -> None:
        asyncio.run_coroutine_threadsafe(server.shutdown(), loop).result(5.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(5.0)

    return server_end(close)
