"""The free gains of a law, and the law as a function of them.

The paper pulls its gains out of the loop into a static K (Section III-B): the law's matrices are
then affine in the gains. Whether that holds for a law as its file writes it is tried out once; if
so, a law for new gains costs a few additions, and if not it is built anew from the file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_design.linear import LinearLaw, linearise_law
from gfm_design.operating_point import OperatingPoint
from gfm_runtime.errors import LawError
from gfm_runtime.expressions import evaluate
from gfm_runtime.lawfile import LawFile, build_law
from gfm_runtime.realise import realise

Vector = NDArray[np.float64]

_MATRICES = ("A", "B", "C", "D", "B_r", "D_r")
_AFFINE = 1e-9  # relative misfit at a point away from the base that still counts as affine


@dataclass(frozen=True)
class FreeGain:
    """A parameter of a law file that synthesis may choose, within [low, high]."""

    name: str
    start: float
    low: float
    high: float

    @property
    def by_ratio(self) -> bool:
        """Searched by its logarithm: a gain that cannot change its sign."""
        return self.low > 0.0


def free_gains(
    file: LawFile,
    start: Mapping[str, float] | None = None,
    only: Sequence[str] | None = None,
) -> tuple[FreeGain, ...]:
    """The gains that the file declares free, with other starts or fewer of them if wanted.

    Raises:
        LawError: an unknown or fixed name, none at all, a start outside its bounds.
    """
    declared = {n: p for n, p in file.parameters.items() if p.free is not None}
    for name in [*(start or {}), *(only or [])]:
        if name not in declared:
            known = sorted(declared)
            raise LawError(f"gain {name}", f"not free in {file.name}; free are {known}")
    wanted = [n for n in declared if only is None or n in only]
    if not wanted:
        raise LawError(f"law {file.name}", "declares no free gain (parameters.NAME.free)")
    gains = []
    for name in wanted:
        p = declared[name]
        assert p.free is not None
        low, high = p.free
        value = (start or {}).get(name, p.value)
        if not low <= value <= high:
            raise LawError(f"gain {name}", f"start {value:g} lies outside [{low:g}, {high:g}]")
        gains.append(FreeGain(name, value, low, high))
    return tuple(gains)


def tied(file: LawFile, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` with every parameter that the file ties to others, e.g. k_35 = k_34 / D_q."""
    numbers = {n: p.value for n, p in file.parameters.items()} | dict(values)
    out = dict(values)
    for name, p in file.parameters.items():
        if p.tied is not None:
            out[name] = evaluate(f"parameters.{name}.tied", p.tied, numbers)
    return out


class GainedLaw:
    """A law around an operating point, as a function of its free gains.

    Args:
        file: the law file.
        gains: which of its parameters are free.
        op, ref, dc_control: as for ``gfm_design.linear.linearise_law``.
    """

    def __init__(
        self,
        file: LawFile,
        gains: Sequence[FreeGain],
        op: OperatingPoint,
        ref: Vector,
        dc_control: bool = True,
    ) -> None:
        self.file, self.gains = file, tuple(gains)
        self._op, self._ref, self._dc_control = op, ref, dc_control
        self._affine = self._try_affine()

    @property
    def is_affine(self) -> bool:
        """The law's matrices are affine in the gains, as the paper's G and K need."""
        return self._affine is not None

    def named(self, values: Vector) -> dict[str, float]:
        """The gains by name, tied parameters included."""
        free = {g.name: float(v) for g, v in zip(self.gains, values, strict=True)}
        return tied(self.file, free)

    def __call__(self, values: Vector) -> LinearLaw:
        """The law at these gains.

        Raises:
            LawError: the gains make no law.
        """
        if self._affine is None:
            return self._build(values)
        base, slopes = self._affine
        return LinearLaw(
            *(m + np.tensordot(values, s, 1) for m, s in zip(base, slopes, strict=True))
        )

    def _build(self, values: Vector) -> LinearLaw:
        law = build_law(self.file, self.named(values))
        return linearise_law(law, realise(law), self._op, self._ref, self._dc_control)

    def _try_affine(self) -> tuple[list[Vector], list[Vector]] | None:
        at = np.array([g.start for g in self.gains])
        step = np.array([0.1 * (abs(g.start) or 1.0) for g in self.gains])
        here = self._build(at)
        sides = [self._build(at + np.eye(len(at))[k] * step[k]) for k in range(len(at))]
        far = self._build(at + 0.7 * step)
        base, slopes = [], []
        for name in _MATRICES:
            m = getattr(here, name)
            if any(getattr(s, name).shape != m.shape for s in [*sides, far]):
                return None
            slope = np.array([(getattr(s, name) - m) / h for s, h in zip(sides, step, strict=True)])
            predicted = m + np.tensordot(0.7 * step, slope, 1)
            misfit = np.abs(predicted - getattr(far, name)).max(initial=0.0)
            if misfit > _AFFINE * max(1.0, np.abs(m).max(initial=0.0)):
                return None
            base.append(m - np.tensordot(at, slope, 1))
            slopes.append(slope)
        return base, slopes
