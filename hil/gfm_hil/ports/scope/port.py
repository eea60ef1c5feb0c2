"""The scope as a port: it also shows runs that are over."""

import argparse
from pathlib import Path

from gfm_hil.core.errors import UserError
from gfm_hil.core.identity import address
from gfm_hil.ports.port import BesideRun, OperatorPort, make_tls, say

_OPERATOR = "operator"  # who has the address with control if no names are given


class ScopePort(OperatorPort):
    """The scope of ``gfmhil scope``."""

    text = (
        "Serves a page with the run's signals. Who opens it with the token that is "
        "printed can also control the run; others can look."
    )
    risk, remedy = "unencrypted", "give --cert and --key, or --plain if that is meant"
    opens = "--plain", "serve beyond this machine unencrypted: everybody on the way sees the token"
    needs = "websockets", "websockets", "the scope", "scope"
    stays = or_any = networks = True

    def options(self, command: argparse.ArgumentParser) -> None:
        command.add_argument(
            "--name", action="append", default=[],
            help="name by which browsers reach it; repeatable",
        )  # fmt: skip
        command.add_argument("--cert", type=Path, metavar="PEM", help="serve https with this")
        command.add_argument("--key", type=Path, metavar="PEM", help="its private key")
        command.add_argument(
            "--operator", action="append", metavar="NAME",
            help="print an address with control for NAME, under which the run's log has what is "
            "commanded with it; may be repeated",
        )  # fmt: skip

    def check(self, options: argparse.Namespace) -> None:
        if (options.cert is None) != (options.key is None):
            raise UserError("--cert, --key: give both or none")
        if options.cert is not None:
            words = f"--cert {options.cert} --key {options.key}"
            self.tls = make_tls(words, options.cert, options.key)
        super().check(options)

    def serve(self, run: BesideRun, options: argparse.Namespace) -> int:
        from gfm_hil.ports.scope.recording import open_recording
        from gfm_hil.ports.scope.server import Scope
        from gfm_hil.ports.scope.session import Access

        run.wait(commands=False)
        access = Access(
            [*options.name, options.host], dict.fromkeys(options.operator or [_OPERATOR])
        )
        scope = Scope([open_recording(place) for place in run.places.values()], access)

        def ready(port: int) -> None:
            where = f"http{'s' if self.tls else ''}://{address((options.host, port))}/"
            say(f"scope, to look: {where}")
            for name, token in access.tokens.items():
                whose = "" if name == _OPERATOR else f" ({name})"
                say(f"with control{whose}:   {where}#token={token}")

        ports = [self.number, 0] if options.port is None else [options.port]
        run.serve_until(scope.serve(options.host, ports, self.tls, ready), lambda: run.interrupted)
        return 0
