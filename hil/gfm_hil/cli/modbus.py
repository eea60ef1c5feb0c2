"""gfmhil modbus: serve a run that is going on as a SunSpec device on Modbus/TCP."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from gfm_hil.core.errors import UserError

PORT = 5020
_LOOK_S = 0.1


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Serve a run that is going on as a SunSpec device on Modbus/TCP, to its end."
    )
    command.add_argument("folder", nargs="?", type=Path, metavar="RUN", help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument(
        "--host", default="127.0.0.1",
        help="address to listen on; any that others can reach needs --tls (%(default)s)",
    )  # fmt: skip
    command.add_argument("--port", type=int, default=PORT, help="0: a free one (%(default)s)")
    command.add_argument(
        "--tls", nargs=3, type=Path, metavar=("CERT", "KEY", "CLIENT-CA"),
        help="TLS with a certificate of ours, and one of every client, signed by CLIENT-CA",
    )  # fmt: skip
    command.add_argument(
        "--anyone-may-command", action="store_true",
        help="listen without TLS: every client that reaches the port can command the bench",
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


def call(options: argparse.Namespace) -> int:
    from gfm_hil.ports.modbus.image import vendor_model
    from gfm_hil.ports.modbus.serve import LOCAL, Address, begun, serve

    if options.vendor_model:
        print(vendor_model(), end="")
        return 0
    if options.folder is None:
        raise UserError("RUN: missing; the run folder")
    if options.control is not None:
        if not options.folder.is_dir():
            raise UserError(f"{options.folder}: no such folder")
        flag = options.folder / LOCAL
        flag.touch() if options.control == "local" else flag.unlink(missing_ok=True)
        return 0
    if options.heartbeat < 0:
        raise UserError(f"--heartbeat {options.heartbeat}: must be >= 0 ms")
    tls = None if options.tls is None else tuple(options.tls)
    address = Address(options.host, options.port, tls, options.anyone_may_command)
    address.check()
    while options.wait and not begun(options.folder):
        time.sleep(_LOOK_S)
    serve(options.folder, address, options.heartbeat, lambda text: print(text, flush=True))
    return 0
