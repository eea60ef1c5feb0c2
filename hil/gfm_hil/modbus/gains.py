"""The droops of the laws of a run as they are at the moment, and the command that changes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from gfm_hil.modbus.droops import Droops, droops
from gfm_runtime import LawError, law_file


class Gains:
    """Of the laws that are ready.

    Args:
        laws: their names.
    """

    def __init__(self, laws: Sequence[str]) -> None:
        self._files = {name: law_file(name) for name in laws}
        self._droops = lru_cache(maxsize=64)(
            lambda law, changed: droops(self._files[law], dict(changed))
        )

    def droops(self, law: str, changed: Mapping[str, float]) -> Droops:
        """D_p and D_q of a law, some of whose parameters are not as in its file."""
        found: Droops = self._droops(law, tuple(changed.items()))
        return found

    def event(
        self, law: str, changed: Mapping[str, float], wanted: Mapping[str, float]
    ) -> dict[str, Any]:
        """The command that gives a law other droops.

        Raises:
            ValueError: it has none of that name, or cannot have this value.
        """
        now = self.droops(law, changed)
        for name, value in wanted.items():
            if getattr(now, name) is None:
                raise ValueError(f"{name} = {value:g}: {law} has no {name}")
            if not value > 0:
                raise ValueError(f"{name} = {value:g}: must be > 0")
        try:
            droops(self._files[law], {**changed, **wanted})
        except LawError as problem:
            raise ValueError(str(problem)) from None
        return {"type": "gains", "values": dict(wanted)}
