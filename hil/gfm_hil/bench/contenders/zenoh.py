"""Eclipse Zenoh, by the package eclipse-zenoh."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gfm_hil.bench.contenders import Contender, PackageEnd, free_port
from gfm_hil.bench.contenders.ours import UDP
from gfm_hil.bench.pingpong import Messages
from gfm_hil.core.roles import Role

_ROOM = 64  # messages, as in the links


def contenders(folder: Path) -> Iterator[Contender]:
    tcp = f"tcp/127.0.0.1:{free_port()}"
    yield Contender("zenoh tcp", "zenoh", tcp, Zenoh, "zenoh", limit=UDP)


class Zenoh(PackageEnd):
    """One end of two peers without a router: an express publisher, which does not batch, of the
    highest priority, and a subscriber whose ring the caller polls."""

    def __init__(self, c: Contender, role: Role, own: Messages) -> None:
        import zenoh

        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("transport/shared_memory/enabled", "false")  # it outlives a kill
        way = "listen" if role == "controller" else "connect"
        config.insert_json5(f"{way}/endpoints", json.dumps([c.endpoint]))
        if way == "connect":
            config.insert_json5("listen/endpoints", "[]")
        self._session = zenoh.open(config)
        out, into = self.WAYS[role]
        self._publisher = self._session.declare_publisher(
            f"gfmhil/{out}",
            express=True,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        ring: Any = zenoh.handlers.RingChannel(_ROOM)
        self._subscriber = self._session.declare_subscriber(f"gfmhil/{into}", ring)

        self.send, self.close = self._publisher.put, self._session.close

    def receive(self) -> bytes | None:
        sample = self._subscriber.try_recv()
        return None if sample is None else bytes(sample.payload)
