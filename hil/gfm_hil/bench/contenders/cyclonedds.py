"""Eclipse Cyclone DDS, by the package cyclonedds."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gfm_hil.bench.contenders import Contender, PackageEnd
from gfm_hil.bench.contenders.ours import UDP
from gfm_hil.bench.pingpong import Messages
from gfm_hil.core.roles import Role

#: on the loopback interface without multicast; its receiving thread hands a sample on by itself
_SETTINGS = """<CycloneDDS><Domain><General>
<Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
_DOMAINS = 230  # numbers that a domain may have


def contenders(folder: Path) -> Iterator[Contender]:
    domain = str(1 + os.getpid() % _DOMAINS)
    yield Contender("cyclonedds", "cyclonedds", domain, Dds, "cyclonedds", limit=UDP)


class Dds(PackageEnd):
    """One end: a writer and a reader, best effort, the last sample alone."""

    def __init__(self, c: Contender, role: Role, own: Messages) -> None:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.idl import make_idl_struct, types
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        kinds: Any = types
        fields = {"content": kinds.sequence[kinds.uint8]}
        message: Any = make_idl_struct("Message", "gfmhil.Message", fields)
        qos = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1))
        number = int(c.endpoint)
        settings = Domain(number, _SETTINGS)
        participant = DomainParticipant(number)
        out, into = self.WAYS[role]
        self._writer = DataWriter(participant, Topic(participant, out, message), qos)
        self._reader = DataReader(participant, Topic(participant, into, message), qos)
        self._message = message
        self._keep = [settings, participant]

    def send(self, message: bytes) -> None:
        self._writer.write(self._message(content=message))

    def receive(self) -> bytes | None:
        samples = self._reader.take(1)
        return bytes(samples[0].content) if samples else None

    def close(self) -> None:
        del self._writer, self._reader
        self._keep.clear()
