"""A run in name only for the XCP slave, and packets as XCP's tables have them."""

import struct
from typing import Any

from pydantic import TypeAdapter

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES
from gfm_hil.ports.xcp.memory import Memory
from gfm_hil.ports.xcp.slave import Slave
from gfm_hil.recording.columns import ColumnSet
from gfm_hil.scenario.events import AnyEvent

LAWS = ("mimo-gfm", "vsg-5", "vsg-2")
MASTER = ("127.0.0.1", 40000)
CONNECT = b"\xff\x00"
_EVENT: TypeAdapter[Any] = TypeAdapter(AnyEvent)


class MadeUpRun:
    """An operator's view of a run; every command that comes must be an event of a scenario."""

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []
        self.refuses = ""
        names = [name for role in ROLES for name in ColumnSet(False).signals(role)]
        self.now: dict[str, Any] = {name: 0.5 + k for k, name in enumerate(names)}
        self.now |= {"tick": 7, "state": "RUNNING", "active": "vsg-5", "gains": {}}
        self.now |= {"ref_P_ref": 0.5, "law": 1.0}

    def snapshot(self) -> dict[str, Any]:
        return self.now

    def command(self, event: dict[str, Any], by: Any = None) -> dict[str, Any]:
        _EVENT.validate_python({**event, "tick": 0})
        if self.refuses:
            raise UserError(self.refuses)
        self.told.append(event)
        if event["type"] == "reference":
            self.now |= {f"ref_{n}": v for n, v in event.items() if n != "type"}
        elif event["type"] == "law":
            self.now |= {"active": event["law"], "gains": {}}
        else:
            self.now["gains"] = {**self.now["gains"], **event["values"]}
        return {"tick": 8}


def slave(run: MadeUpRun, writes: bool = True, **more: Any) -> Slave:
    """A slave of that run."""
    memory = Memory(run, LAWS, False, lambda: 100)
    return Slave(memory, "gfmhil", memory.a2l("bench"), writes, **more)


def datagram(*packets: bytes, counter: int = 0) -> bytes:
    """XCP on Ethernet: LEN and CTR before each packet."""
    return b"".join(
        struct.pack("<HH", len(packet), counter + k) + packet for k, packet in enumerate(packets)
    )


def set_mta(address: int, extension: int = 0) -> bytes:
    return struct.pack("<BHBI", 0xF6, 0, extension, address)


def short_upload(address: int, count: int, extension: int = 0) -> bytes:
    return struct.pack("<BBBBI", 0xF4, count, 0, extension, address)


def download(*values: float) -> bytes:
    return struct.pack(f"<BB{len(values)}d", 0xF0, 8 * len(values), *values)


def short_download(address: int, *values: float) -> bytes:
    head = struct.pack("<BBBBI", 0xED, 8 * len(values), 0, 0, address)
    return head + struct.pack(f"<{len(values)}d", *values)
