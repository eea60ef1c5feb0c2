"""A run as a SunSpec device on Modbus/TCP, as a port."""

from __future__ import annotations

import argparse
import asyncio
import logging
import time
from pathlib import Path
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import Identity
from gfm_hil.core.supervised import supervised
from gfm_hil.ports.modbus.connection import CLIENT, UNIT, Server
from gfm_hil.ports.modbus.device import TICK_S, Device
from gfm_hil.ports.modbus.image import BASE, vendor_model
from gfm_hil.ports.modbus.run_state import Watcher
from gfm_hil.ports.port import BesideRun, OperatorPort, make_tls, say
from gfm_hil.scenario import load_scenario

LOCAL = "modbus-local"  # in the run folder while the bench is commanded there
_LOOK_S = 0.1  # poll interval of what changes rarely
_LOOKS = 10  # such polls per update of the slack
_TIMER = Identity(through="modbus", name="timer")


class ModbusPort(OperatorPort):
    """The SunSpec device of ``gfmhil modbus``."""

    text = "Serve a run that is going on as a SunSpec device on Modbus/TCP, to its end."
    risk = "and Modbus does not ask who commands"
    remedy = "use --tls CERT KEY CLIENT-CA, or --anyone-may-command"
    opens = (
        "--anyone-may-command",
        "listen without TLS: every client that reaches the port can command the bench",
    )
    commands = True

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
            "--vendor-model", action="store_true", help="print the vendor model's file, and end"
        )

    def instead(self, options: argparse.Namespace) -> bool:
        if options.vendor_model:
            print(vendor_model(), end="")
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
        operator = run.operator()
        scenario = load_scenario(str(run.folder / "scenario.toml"))
        watcher = Watcher(operator, run.folder, scenario)
        run.first(watcher.look)
        began = time.monotonic()

        def command(event: dict[str, Any]) -> None:
            client = CLIENT.get()
            by = _TIMER if client is None else client.identity
            if event["type"] == "stop":
                operator.stop(by)
            else:
                operator.command(event, by)
            watcher.forget()

        device = Device(
            scenario, watcher.laws(), watcher.look, command, options.heartbeat,
            lambda: time.monotonic() - began,
        )  # fmt: skip

        async def serve() -> None:
            try:
                server = make_server(device, (options.host, options.port), self.tls)
                await server.serve_forever(background=True)
            except (RuntimeError, OSError):
                where = f"--host {options.host} --port {options.port}"
                raise UserError(f"{where}: cannot listen there") from None
            try:
                kind = "Modbus/TCP with TLS" if self.tls else "Modbus/TCP"
                where = f"{options.host}:{server.peers.port}"
                say(f"{kind} on {where}, unit {UNIT}, SunSpec from {BASE}")
                await asyncio.gather(
                    supervised("the clock of the Modbus server", lambda: tick(device, began)),
                    supervised(
                        "the Modbus server's look at the run",
                        lambda: watch(run.folder, device, watcher, server),
                    ),
                )
            finally:
                await server.shutdown()

        run.serve_until(serve())
        return 0


def make_server(device: Device, address: tuple[str, int], tls: Any = None) -> Server:
    """The server of a device; raises OSError if the address cannot be bound."""

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
    return Server(SimDevice(id=UNIT, simdata=[block], action=action), address, tls)


async def tick(device: Device, began: float) -> None:
    """Let the device's clock tick; one tick makes up for those that were missed."""
    k = 0
    while True:
        await device.clock()
        k = max(k + 1, int((time.monotonic() - began) / TICK_S))
        await asyncio.sleep(began + k * TICK_S - time.monotonic())


async def watch(folder: Path, device: Device, watcher: Watcher, server: Server) -> None:
    """Poll what changes rarely; the clock does not depend on it."""
    while True:
        device.slack = watcher.slack()
        for _ in range(_LOOKS):
            device.take((folder / LOCAL).exists())
            server.peers.reap()
            await asyncio.sleep(_LOOK_S)
