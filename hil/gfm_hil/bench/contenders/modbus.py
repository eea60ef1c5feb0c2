"""Modbus/TCP, by the package pymodbus."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gfm_hil.bench.contenders import Contender, free_port, udp
from gfm_hil.bench.pingpong import LONGEST, Messages, Numbers, PingPong
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role
from gfm_hil.realtime.clock import wait_until

_MOST = 121  # registers that function 23 may write


def contenders(names: Sequence[str], place: Path) -> Iterator[Contender]:
    if "modbus" in names:
        port = str(free_port())
        yield Contender("modbus tcp", "modbus", port, _open, "pymodbus", limit=udp.LIMIT)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    """The controller is the server. A request of the plant writes y and reads u at once (function
    23), as registers of 16 bits; both have the size of y."""
    if not 2 <= (size := own.shape[1]) <= min(2 * _MOST, LONGEST):
        raise UserError(f"a Modbus message holds 2 to {2 * _MOST} bytes")
    if role == "controller":
        return _server(int(c.endpoint))
    from pymodbus.client import ModbusTcpClient

    client = ModbusTcpClient("127.0.0.1", port=int(c.endpoint), timeout=1.0, retries=0)
    if not client.connect():
        raise UserError(f"no Modbus server at port {c.endpoint}")
    registers = [row[: size // 2 * 2].view(">u2").tolist() for row in own]
    n = size // 2

    def ping(stop: Numbers, period_ns: int, duration_ns: int, took: Numbers) -> int:
        begin = time.monotonic_ns()
        end, due, done = begin + duration_ns, begin + period_ns, 0
        while done < len(took) and begin < end:
            if period_ns:
                wait_until(due, 0)
                begin, due = due, due + period_ns
            values = registers[done % len(registers)]
            answer = client.readwrite_registers(
                read_address=0, read_count=n, write_address=_MOST, values=values
            )
            if answer.isError():
                return -1
            now = time.monotonic_ns()
            took[done], begin = now - begin, now
            done += 1
        return done

    return PingPong(ping, lambda stop: None, client.close, False)


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

    return PingPong(lambda *_: -1, lambda stop: None, close, False)
