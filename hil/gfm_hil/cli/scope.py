"""gfmhil scope: a live scope, or a look back, in the browser."""

from __future__ import annotations

import argparse
import os
import ssl
import sys
import time
from pathlib import Path

from gfm_hil.core.errors import UserError, need
from gfm_hil.links.zeromq.options import beyond_loopback

PORT = 8470
_LOOK_S = 0.1
_OPERATOR = "operator"  # who has the address with control if no names are given
_NICENESS = 5  # the loop comes first, also where it has no real-time rights


def add(command: argparse.ArgumentParser) -> None:
    command.description = (
        "Serves a page with the run's signals. Who opens it with the token that is "
        "printed can also control the run; others can look."
    )
    command.add_argument("folder", type=Path, help="the run folder")
    command.add_argument("--wait", action="store_true", help="wait for the run to begin")
    command.add_argument("--port", type=int, help=f"{PORT} or else a free one by default")
    command.add_argument("--host", default="127.0.0.1", help="address to serve at: loopback only")
    command.add_argument(
        "--name", action="append", default=[], help="name by which browsers reach it; repeatable"
    )
    command.add_argument("--cert", type=Path, metavar="PEM", help="serve https with this")
    command.add_argument("--key", type=Path, metavar="PEM", help="its private key")
    command.add_argument(
        "--plain", action="store_true",
        help="serve beyond this machine without encryption: everybody on the way sees the token",
    )  # fmt: skip
    command.add_argument(
        "--operator", action="append", metavar="NAME",
        help="print an address with control for NAME, under which the run's log has what is "
        "commanded with it; may be repeated",
    )  # fmt: skip


def call(options: argparse.Namespace) -> int:
    encryption, ports = check(options)
    need_websockets()
    from gfm_hil.ports.scope.access import Access
    from gfm_hil.ports.scope.record import begun, open_record
    from gfm_hil.ports.scope.server import Scope, run_scope

    while options.wait and not begun(options.folder):
        time.sleep(_LOOK_S)
    os.nice(_NICENESS)
    access = Access([*options.name, options.host], dict.fromkeys(options.operator or [_OPERATOR]))
    scope = Scope(open_record(options.folder), access)

    def ready(port: int) -> None:
        host = f"[{options.host}]" if ":" in options.host else options.host
        address = f"http{'s' if encryption else ''}://{host}:{port}/"
        print(f"scope, to look: {address}")
        for name, token in access.tokens.items():
            whose = "" if name == _OPERATOR else f" ({name})"
            print(f"with control{whose}:   {address}#token={token}")
        sys.stdout.flush()

    run_scope(scope, options.host, ports, encryption, ready)
    return 0


def need_websockets() -> None:
    """Raise UserError if what the scope needs is not installed."""
    need("websockets", "websockets", "the scope", "scope")


def check(options: argparse.Namespace) -> tuple[ssl.SSLContext | None, list[int]]:
    """Encryption, if it is to be, and the ports to try.

    Raises:
        UserError: an option that cannot be, or a way beyond this machine that everybody can read.
    """
    if options.port is not None and not 0 <= options.port <= 65535:
        raise UserError(f"--port {options.port}: must be 0 (any) to 65535")
    if (options.cert is None) != (options.key is None):
        raise UserError("--cert, --key: give both or none")
    encryption = None
    if options.cert is not None:
        encryption = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            encryption.load_cert_chain(options.cert, options.key)
        except (OSError, ssl.SSLError) as problem:
            raise UserError(f"--cert {options.cert} --key {options.key}: {problem}") from None
    elif not options.plain and beyond_loopback(f"tcp://{options.host}:0"):
        raise UserError(
            f"--host {options.host}: goes beyond this machine, unencrypted: give --cert and --key, "
            "or --plain if that is meant"
        )
    return encryption, [PORT, 0] if options.port is None else [options.port]
