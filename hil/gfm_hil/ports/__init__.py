"""An operator's ways into a run in progress: commands, streams, the scope, Modbus and XCP.

Each port is a process of its own beside the run: it reads the recording, to which the loops only
append, and passes commands to the command servers of both sides. No loop waits for it. A new port
is a subclass of ``OperatorPort`` and one line in ``PORTS``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from gfm_hil.ports.port import OperatorPort


class PortEntry(NamedTuple):
    """Module and class of a port, what it does, and its number by default."""

    module: str
    kind: str
    text: str
    number: int


#: by the name of the command ``gfmhil NAME RUN`` and of the option ``gfmhil run --NAME``
PORTS = {
    "scope": PortEntry(
        "scope.port", "ScopePort", "show a run in the browser while it goes on, or afterwards", 8470
    ),
    "stream": PortEntry(
        "streams.port",
        "StreamPort",
        "stream what a run records to PlotJuggler, your own tools or Prometheus",
        9872,
    ),
    "modbus": PortEntry(
        "modbus.port",
        "ModbusPort",
        "serve a run that is going on as a SunSpec device on Modbus/TCP",
        5020,
    ),
    "xcp": PortEntry(
        "xcp.port",
        "XcpPort",
        "serve a run that is going on to a calibration tool, by XCP on UDP or CAN FD",
        5555,
    ),
}


def make_port(name: str) -> OperatorPort:
    """A port of the registry."""
    entry = PORTS[name]
    found: OperatorPort = getattr(import_module(f"gfm_hil.ports.{entry.module}"), entry.kind)(name)
    return found
