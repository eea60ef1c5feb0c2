"""iceoryx2, a package from PyPI for shared memory."""

import ctypes
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gfm_hil.bench.contenders import Contender, PackageEnd
from gfm_hil.bench.contenders.ours import SHM
from gfm_hil.bench.pingpong import LONGEST, Messages
from gfm_hil.core.roles import Role

_ROOM = 64  # messages, as in the links


def contenders(folder: Path) -> Iterator[Contender]:
    name = f"gfmhil-{secrets.token_hex(8)}"
    yield Contender("iceoryx2", "iceoryx2", name, Iceoryx2, "iceoryx2", limit=SHM)


class Iceoryx2(PackageEnd):
    """One end over two services of its publish-subscribe, driven from Python, as a link is."""

    def __init__(self, c: Contender, role: Role, own: Messages) -> None:
        import iceoryx2 as iox2

        iox2.set_log_level(iox2.LogLevel.Fatal)
        node = iox2.NodeBuilder.new().create(iox2.ServiceType.Ipc)

        def service(way: str) -> Any:
            return (
                node.service_builder(iox2.ServiceName.new(f"{c.endpoint}/{way}"))
                .publish_subscribe(iox2.Slice[ctypes.c_uint8])
                .subscriber_max_buffer_size(_ROOM)
                .open_or_create()
            )

        out, into = map(service, self.WAYS[role])
        self._publisher = out.publisher_builder().initial_max_slice_len(LONGEST).create()
        self._subscriber = into.subscriber_builder().create()
        self._keep: list[Any] = [node, out, into]

    def send(self, message: bytes) -> None:
        sample = self._publisher.loan_slice_uninit(len(message))
        ctypes.memmove(sample.payload().as_ptr(), message, len(message))
        sample.assume_init().send()

    def receive(self) -> bytes | None:
        if (sample := self._subscriber.receive()) is None:
            return None
        payload = sample.payload()
        return ctypes.string_at(payload.as_ptr(), payload.len())

    def close(self) -> None:
        self._publisher.delete()
        self._subscriber.delete()
        self._keep.clear()
