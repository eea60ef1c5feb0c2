"""A second process that compiles a share of what a run calls, while the first compiles the rest.

The share is compiled for the types of a bench's records, without its operating point. The first
process then loads what the second has put into numba's cache, and compiles what it has not.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from gfm_hil.core.roles import Role
from gfm_hil.scenario import Scenario


class Beside:
    """The second process, as a context that ends it.

    Args:
        scenario: checked.
        roles: the sides that it compiles for.
        notice: told when it starts, and when this process has to wait for it.
    """

    def __init__(
        self, scenario: Scenario, roles: Sequence[Role], notice: Callable[[str], None]
    ) -> None:
        self._task, self._notice = (scenario, tuple(roles)), notice
        self._process: subprocess.Popen[bytes] | None = None
        self._is_over = False  # its share is next here

    def __enter__(self) -> "Beside":
        return self

    def __exit__(self, *problem: Any) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def begin(self, text: str) -> None:
        """Pass on that a set of functions is being compiled; before the first one, start the
        process, unless this machine has one processor or nothing but its share is left."""
        self._notice(text)
        if self._process is None and not self._is_over and len(os.sched_getaffinity(0)) > 1:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__], stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            assert self._process.stdin is not None
            with suppress(BrokenPipeError), self._process.stdin as into:
                pickle.dump(self._task, into)

    def wait(self) -> None:
        """Wait until it has done its work."""
        self._is_over = True
        if self._process is not None and self._process.poll() is None:
            self._notice("compiling the rest, in a second process (once a machine) …")
            self._process.wait()


if __name__ == "__main__":
    from gfm_hil.engine.compiling import compile_share
    from gfm_runtime.children import end_with_parent

    end_with_parent()
    compile_share(*pickle.load(sys.stdin.buffer))
