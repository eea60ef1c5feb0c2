"""The server of one run: it serves the register image over Modbus/TCP until the run ends."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import os
import signal
import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity
from gfm_hil.core.roles import ROLES
from gfm_hil.core.supervised import supervised
from gfm_hil.engine.announcement import not_running, present
from gfm_hil.ports.commands import Operator
from gfm_hil.ports.modbus.connection import CLIENT, UNIT, Server
from gfm_hil.ports.modbus.device import TICK_S, Device
from gfm_hil.ports.modbus.image import BASE
from gfm_hil.ports.modbus.view import Watcher
from gfm_hil.scenario import load_scenario

LOCAL = "modbus-local"  # in the run folder while the bench is commanded there

_LOOK_S = 0.1  # poll interval of what changes rarely
_LOOKS = 10  # such polls per update of the slack
_TIMER = Identity(through="modbus", name="timer")
_NICE = 10  # below every process with deadlines


@dataclass(frozen=True)
class Address:
    """Where to listen, and to whom.

    Attributes:
        tls: certificate, key, and the CA of the clients' certificates; None: no TLS.
        anyone: deliberately serve without TLS on an address that others can reach.
    """

    host: str
    port: int
    tls: tuple[Path, Path, Path] | None = None
    anyone: bool = False

    def check(self) -> None:
        """Raise UserError for an address that others can reach without authentication."""
        try:
            address = ipaddress.ip_address(self.host)
        except ValueError:
            raise UserError(f"--host {self.host!r}: must be an IP address") from None
        if not 0 <= self.port <= 65535:
            raise UserError(f"--port {self.port}: must lie in [0, 65535]")
        if not (address.is_loopback or self.tls or self.anyone):
            raise UserError(
                f"--host {self.host}: others can reach it, and Modbus has no authentication; use "
                "--tls CERT KEY CLIENT-CA, or --anyone-may-command"
            )

    def context(self) -> ssl.SSLContext | None:
        """A TLS context that requires a certificate from clients too.

        Raises:
            UserError: a file cannot be used.
        """
        if self.tls is None:
            return None
        certificate, key, clients = self.tls
        found = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        found.minimum_version = ssl.TLSVersion.TLSv1_2
        found.verify_mode = ssl.CERT_REQUIRED
        try:
            found.load_cert_chain(certificate, key)
            found.load_verify_locations(clients)
        except (OSError, ssl.SSLError) as problem:
            raise UserError(f"--tls {certificate} {key} {clients}: {problem}") from None
        return found


def serve(folder: Path, address: Address, heartbeat_ms: int, notice: Callable[[str], None]) -> None:
    """Serve the run in ``folder`` until it ends, or until SIGINT or SIGTERM.

    Raises:
        UserError: no run is in progress there, or the address cannot be bound.
    """
    address.check()
    context = address.context()
    operator = Operator(folder)
    try:
        asyncio.run(_serve(folder, operator, address, context, heartbeat_ms, notice))
    finally:
        operator.close()


async def _serve(
    folder: Path,
    operator: Operator,
    address: Address,
    context: ssl.SSLContext | None,
    heartbeat_ms: int,
    notice: Callable[[str], None],
) -> None:
    logging.getLogger("pymodbus.logging").setLevel(logging.CRITICAL)  # clients get the errors
    scenario = load_scenario(str(folder / "scenario.toml"))
    watcher = Watcher(operator, folder, scenario)
    over = _until_told()
    while watcher.look() is None:  # the handshake may not be over
        if over.is_set() or not _going(folder):
            raise not_running(folder)
        await asyncio.sleep(TICK_S)
    began = time.monotonic()

    def tell(event: dict[str, Any]) -> None:
        client = CLIENT.get()
        by = _TIMER if client is None else client.identity
        if event["type"] == "stop":
            operator.stop(by)
        else:
            operator.tell(event, by)
        watcher.forget()

    device = Device(
        scenario, watcher.laws(), watcher.look, tell, heartbeat_ms,
        lambda: time.monotonic() - began,
    )  # fmt: skip
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    try:
        server = _server(device, address, context)
        await server.serve_forever(background=True)
    except (RuntimeError, OSError):
        where = f"--host {address.host} --port {address.port}"
        raise UserError(f"{where}: cannot listen there") from None
    try:
        kind = "Modbus/TCP" if context is None else "Modbus/TCP with TLS"
        port = server.peers.port
        notice(f"{kind} on {address.host}:{port}, unit {UNIT}, SunSpec from {BASE}")
        await asyncio.gather(
            supervised("the clock of the Modbus server", lambda: _clock(device, began, over)),
            supervised(
                "the Modbus server's look at the run",
                lambda: _watch(folder, device, watcher, server, over),
            ),
        )
    finally:
        await server.shutdown()


def _server(device: Device, address: Address, context: ssl.SSLContext | None) -> Server:
    async def action(
        code: int, first: int, at: int, count: int, registers: list[int], written: Any
    ) -> ExcCodes | None:
        refused = await device.access(code, at, written)
        image = device.image.registers
        registers[: len(image)] = image
        if written is not None:  # pymodbus writes them to its registers
            written[:] = image[at - first : at - first + count]
        return refused

    block = SimData(BASE, values=device.image.registers, datatype=DataType.REGISTERS)
    sim = SimDevice(id=UNIT, simdata=[block], action=action)
    return Server(sim, (address.host, address.port), context)


async def _clock(device: Device, began: float, over: asyncio.Event) -> None:
    """Tick until the run is over; one tick makes up for those that were missed."""
    tick = 0
    while not over.is_set():
        await device.clock()
        tick = max(tick + 1, int((time.monotonic() - began) / TICK_S))
        await _rest(over, began + tick * TICK_S - time.monotonic())


async def _watch(
    folder: Path, device: Device, watcher: Watcher, server: Server, over: asyncio.Event
) -> None:
    """Poll what changes rarely until the run is over; the clock does not depend on it."""
    while not over.is_set():
        device.slack = watcher.slack()
        for _ in range(_LOOKS):
            if not _going(folder):
                over.set()
            device.take((folder / LOCAL).exists())
            server.peers.reap()
            await _rest(over, _LOOK_S)


async def _rest(over: asyncio.Event, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(over.wait(), max(seconds, 0))


def begun(folder: Path) -> bool:
    """Whether both sides of a run have started."""
    return len(present(folder)) == len(ROLES)


def _going(folder: Path) -> bool:
    return bool(present(folder))


def _until_told() -> asyncio.Event:
    over = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    return over
