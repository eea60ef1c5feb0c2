"""LCM, by the package lcm."""

import os
from collections.abc import Iterator
from pathlib import Path

from gfm_hil.bench.contenders import Contender, PackageEnd
from gfm_hil.bench.contenders.ours import UDP
from gfm_hil.bench.pingpong import Messages
from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import Role


def contenders(folder: Path) -> Iterator[Contender]:
    port = 10_000 + os.getpid() % 20_000
    group = f"udpm://239.255.76.67:{port}?ttl=0"  # ttl 0: the packets stay on this machine
    yield Contender("lcm", "lcm", group, Lcm, "lcm", limit=UDP)


class Lcm(PackageEnd):
    """One end: two channels of UDP multicast; the caller polls."""

    def __init__(self, c: Contender, role: Role, own: Messages) -> None:
        from lcm import LCM

        super().__init__()
        try:
            self._lcm = LCM(c.endpoint)
        except RuntimeError:
            raise UserError("LCM has no multicast here: ip link set lo multicast on") from None
        self._out, into = self.WAYS[role]
        self._lcm.subscribe(into, lambda _, message: self.arrived.append(message))

    def send(self, message: bytes) -> None:
        self._lcm.publish(self._out, message)

    def receive(self) -> bytes | None:
        self._lcm.handle_timeout(0)
        return super().receive()

    def close(self) -> None:
        del self._lcm
