"""The link ``shm``, and its limit in C: shared memory, a file that both sides map."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from gfm_hil.bench.contenders import Contender, fresh_endpoint, limit, of_link
from gfm_hil.bench.pingpong import Messages, PingPong, in_c
from gfm_hil.core.roles import Role
from gfm_hil.links.base import LONGEST

_SLOTS = 2 * 1024  # bytes, two slot_t
LIMIT = "C shm"


def contenders(names: Sequence[str], folder: Path) -> Iterator[Contender]:
    yield limit(LIMIT, __file__, str(folder / "slots"), _open, LONGEST)
    if "shm" in names:
        yield of_link("shm", "shm", fresh_endpoint("shm", folder), LIMIT)


def _open(c: Contender, role: Role, own: Messages) -> PingPong:
    if role == "controller":
        Path(c.endpoint).write_bytes(bytes(_SLOTS))
    slots = np.memmap(c.endpoint, np.uint8, "r+")
    keep = ExitStack()
    keep.callback(slots.flush)  # keeps the mapping alive with the end
    opened = [slots.ctypes.data, int(role == "controller")]
    return in_c(c.library, opened, own.shape[1], keep)
