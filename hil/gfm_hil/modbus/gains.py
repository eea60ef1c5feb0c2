"""The present droops of a run's laws, and the command that changes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from gfm_hil.modbus.droops import Droops, droops
from gfm_runtime import LawError, law_file


class Gains:
    """Gains of the laws that are ready.

    Args:
        laws: their names.
    """

    def __init__(self, laws: Sequence[str]) -> None:
        self._files = {name: law_file(name) for name in laws}
        self._droops = lru_cache(maxsize=64)(
            lambda law, changed: droops(self._files[law], dict(changed))
        )

    def droops(self, law: str, changed: Mapping[str, float]) -> Droops:
        """D_p and D_q of a law; ``changed`` holds the parameters that differ from its file."""
        found: Droops = self._droops(law, tuple(changed.items()))
        return found

    def event(
        self, law: str, changed: Mapping[str, float], wanted: Mapping[str, float]
    ) -> dict[str, Any]:
        """The command that changes a law's droops.

        Raises:
            ValueError: the law has no droop of that name, or the value is invalid.
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
