"""A run in progress: reads what both roles have recorded so far.

Reading does not disturb the loops, which only append rows to memory-mapped files.
"""

import math
import threading
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gfm_hil.core.errors import UserError
from gfm_hil.core.roles import ROLES, Role
from gfm_hil.recording.columns import Columns, named, recorded_in
from gfm_hil.recording.parts import RolePart
from gfm_runtime.toml_file import read_toml


class LiveRun:
    """The growing recording of a run. A role that has not begun to record has no ticks."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._opening = folder, threading.Lock()
        self._parts: Mapping[Role, RolePart] = {}
        self._columns: Mapping[str, NDArray[Any]] = {}

    @cached_property
    def T_s(self) -> float:
        """The sampling time, s. Raises UserError: scenario.toml does not say it."""
        try:
            T_s = read_toml(self.folder / "scenario.toml", links=False)["T_s"]
            if not isinstance(T_s, float) or not 0 < T_s < math.inf:
                raise ValueError(f"T_s = {T_s!r}: must be a number of seconds")
        except (ValueError, KeyError) as problem:
            raise UserError(f"{self.folder}: scenario.toml: {problem}") from None
        return T_s

    @property
    def parts(self) -> Mapping[Role, RolePart]:
        """The arrays of the sides that have begun to record by now; a side that begins later is in
        the next one."""
        with self._opening:  # by any of the threads that read
            for role in ROLES:
                if (
                    role not in self._parts
                    and (part := RolePart.open(self.folder, role)) is not None
                ):
                    self._parts = {**self._parts, role: part}
                    own = named(role, part.signals, part.times) | part.of_network()
                    self._columns = {**self._columns, **own}
            return self._parts

    @property
    def columns(self) -> Columns:
        """Every column of the sides that have begun to record, under the names of signals.npz and
        timing.npz; only rows of ticks that are done have a meaning."""
        return self._columns if self.parts else {}

    def done(self, role: Role) -> int:
        """How many ticks a side has recorded."""
        part = self.parts.get(role)
        return 0 if part is None else int(part.progress[0])

    def row(self, role: Role, tick: int) -> dict[str, float]:
        """What a side recorded in a tick that is done, by column, without its times."""
        values = self.parts[role].signals[tick].tolist()
        return dict(zip(recorded_in(role, len(values)), values, strict=True))

    @property
    def misses(self) -> int:
        """Ticks so far without a fresh u at the plant, as the plant counts them."""
        return int(self.parts["plant"].progress[1]) if self.done("plant") else 0

    @property
    def safe_reason(self) -> int:
        """The reason for which the controller is in SAFE, index into ``REASONS`` of the runtime."""
        return int(self.parts["controller"].progress[1]) if self.done("controller") else 0


def has_begun(folder: Path) -> bool:
    """Whether a role of a run has begun to record in a folder that has the scenario."""
    recorded = any((folder / f"parts/{role}_progress.npy").is_file() for role in ROLES)
    return recorded and (folder / "scenario.toml").is_file()
