"""A Dask cluster as the pool of a study."""

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from gfm_hil.core.errors import UserError
from gfm_hil.studies.workers import Pool, Result


class Cluster(Pool):
    """The workers that a scheduler has; it gives what one had in hand that died to another."""

    is_local = False

    def __init__(self, address: str, client: Any) -> None:
        self._address, self._client = address, client
        self._executor = client.get_executor(pure=False)
        self.workers = sum(client.nthreads().values())
        self.in_hand = 2 * self.workers
        if not self.workers:
            raise UserError(f"cluster {address!r}: it has no workers")

    def submit(self, function: Callable[..., Result], *args: Any) -> Future[Result]:
        future: Future[Result] = self._executor.submit(function, *args)
        return future

    def check_equal(self, digest: Callable[[], object]) -> None:
        mine = _versioned(digest)
        for worker, theirs in self._on_each(partial(_versioned, digest)):
            if isinstance(theirs, Exception):
                raise UserError(
                    f"cluster {self._address!r}: {worker}: {theirs} (give paths in full, in folders"
                    " that all machines of the cluster share)"
                )
            if theirs != mine:
                words = "has another gfmhil, or other files of what is to be run"
                raise UserError(f"cluster {self._address!r}: {worker} {words}")

    def check_shared(self, folder: Path) -> None:
        there = next(place for place in [folder, *folder.parents] if place.is_dir())
        with tempfile.NamedTemporaryFile(prefix=".gfmhil-", dir=there) as mark:
            for worker, sees in self._on_each(Path(mark.name).is_file):
                if sees is not True:
                    raise UserError(
                        f"cluster {self._address!r}: {worker} does not see {there}: the report"
                        " must be in a folder that all machines of the cluster share"
                    )

    def _on_each(self, function: Callable[[], object]) -> list[tuple[str, object]]:
        """What a function gives or raises on each worker, by its address."""
        return [*self._client.run(function, on_error="return").items()]


def _versioned(digest: Callable[[], object]) -> tuple[str, object]:
    return version("gfmhil"), digest()


@contextlib.contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """The cluster at the address of its scheduler. Raises UserError: no ``distributed`` here,
    nobody at the address, or a cluster without workers."""
    try:
        from distributed import Client
    except ImportError:
        words = "a Dask cluster needs the package distributed: pip install 'gfmhil[dask]'"
        raise UserError(words) from None
    try:
        client: Any = Client(address, timeout="10s")
    except (OSError, ValueError) as problem:
        raise UserError(f"cluster {address!r}: no scheduler there: {problem}") from None
    with client:
        yield Cluster(address, client)
