"""The droops of a run's laws, the gains of SunSpec's models 711 and 705, and how to change them.

In the steady state of a law with droops (p.u.; Table III)

    omega_u - omega_g = D_p (P_ref - p),        V - V_ref = D_q (Q_ref - q).

A law has D_p if its file names it and phi_22(0) equals it; it has D_q if its file names it and
phi_34(0)/phi_35(0), or its limit, equals it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from gfm_runtime import LawError, law_file
from gfm_runtime.law import Law
from gfm_runtime.lawfile import LawFile, build_law, tied

_NEARLY_DC = 1e-7j  # rad/s; integrators have no value at 0
_RTOL = 1e-3  # printed gains are rounded


@dataclass(frozen=True)
class Droops:
    """D_p and D_q of a law in p.u.; None for one that it does not have."""

    D_p: float | None
    D_q: float | None


def droops(file: LawFile, changed: Mapping[str, float] | None = None) -> Droops:
    """The droops of a law, optionally with changed parameters; tied parameters follow.

    Raises:
        LawError: the changed law is invalid.
    """
    law = build_law(file, tied(file, dict(changed or {})))
    numbers = {name: p.value for name, p in law.parameters.items()}
    return Droops(
        _own(numbers.get("D_p"), law.element("phi", (1, 1))(_NEARLY_DC)),
        _own(numbers.get("D_q"), _ratio(law)),
    )


def _own(value: float | None, seen: complex) -> float | None:
    if value is None or abs(seen - value) > _RTOL * abs(value):
        return None
    return value


def _ratio(law: Law) -> complex:
    below = law.element("phi", (2, 4))(_NEARLY_DC)
    return law.element("phi", (2, 3))(_NEARLY_DC) / below if below else 0.0


class LawDroops:
    """LawDroops of the laws that are ready."""

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
