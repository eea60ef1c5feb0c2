"""The port of a CAN link whose bus is a socket: its node, for compiled loops."""

from __future__ import annotations

from gfm_hil.links.can.node import LOST, Node, receive, send, sleep
from gfm_hil.links.port import Port, port_function

_SPINS = 200  # looks, about 0.1 ms: the call that sends a frame also delivers it
_PATIENCE = 1  # ms


def can_port(node: Node) -> Port:
    """The port of a node with an open socket."""
    return Port(node.handle, _send, _receive, _SPINS, _await)


@port_function
def _send(handle, message):
    return send(handle, message)


@port_function
def _receive(handle, message):
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)


@port_function
def _await(handle, message):
    sleep(handle, _PATIENCE)
    size = receive(handle, message)
    return -1 if size == LOST else max(0, size)
