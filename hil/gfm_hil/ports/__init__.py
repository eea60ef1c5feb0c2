"""An operator's ways into a run in progress: commands, streams, the scope, Modbus and XCP.

Each port is a process of its own beside the run: it reads the recording, to which the loops only
append, and passes commands to the command servers of both sides. No loop waits for it. A new port
is a subclass of ``Port`` and one line in ``PORTS``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from gfm_hil.ports.port import Port


class Entry(NamedTuple):
    """Module and class of a port, what it does, and its number by default."""

    module: str
    kind: str
    text: str
    number: int


#: by the name of the command ``gfmhil NAME RUN`` and of the option ``gfmhil run --NAME``
PORTS = {
    "scope": Entry(
        "scope.port", "ScopePort", "show a run in the browser while it goes on, or afterwards", 8470
    ),
    "stream": Entry(
        "streams.port",
        "StreamPort",
        "stream what a run records to PlotJuggler, your own tools or Prometheus",
        9872,
    ),
    "modbus": Entry(
        "modbus.port",
        "ModbusPort",
        "serve a run that is going on as a SunSpec device on Modbus/TCP",
        5020,
    ),
    "xcp": Entry(
        "xcp.port",
        "XcpPort",
        "serve a run that is going on to a calibration tool, by XCP on UDP or CAN FD",
        5555,
    ),
}


def make_port(name: str) -> Port:
    """A port of the registry."""
    entry = PORTS[name]
    found: Port = getattr(import_module(f"gfm_hil.ports.{entry.module}"), entry.kind)(name)
    return found
