"""The free gains of a law, and the law as a function of them.

The paper pulls its gains out of the loop into a static K (Section III-B): the law's matrices are
then affine in the gains. ``GainedLaw`` tests this once for a law file. If it holds, a law for new
gains costs a few additions; if not, ``realise_each`` builds the laws of a whole population from the
file in one pass. ``gfm_runtime.realisation`` builds one law with all checks, in some milliseconds;
a search asks for thousands.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gfm_design.model.linear import LinearLaw, closed_law, error_map_slopes, linearise_law
from gfm_design.model.operating_point import OperatingPoint
from gfm_runtime.elements import ZERO, Element
from gfm_runtime.errors import LawError
from gfm_runtime.expressions import evaluate
from gfm_runtime.lawfile import LawFile, build_law, element_of, tied
from gfm_runtime.realisation import LawStateSpace, assemble, realise, row_of
from gfm_runtime.signals import NU, NY, U_NAMES

Vector = NDArray[np.float64]

_GOLDEN = (5.0**0.5 - 1.0) / 2.0  # its multiples modulo 1 never meet
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
        """Whether its logarithm is searched: for a gain that cannot change its sign."""
        return self.low > 0.0


def free_gains(
    file: LawFile, start: Mapping[str, float] | None = None, only: Sequence[str] | None = None
) -> tuple[FreeGain, ...]:
    """The gains that the file declares free, optionally with other starts or only some of them.

    Raises:
        LawError: a name is unknown or not free, there is no free gain, a start belongs to none of
            them or lies outside its bounds, or bounds are not finite and ascending.
    """
    declared = {n: p for n, p in file.parameters.items() if p.free is not None}
    for name in [*(start or {}), *(only or [])]:
        if name not in declared:
            known = sorted(declared)
            raise LawError(f"gain {name}", f"not free in {file.name}; free are {known}")
    wanted = [n for n in declared if only is None or n in only]
    for name in start or {}:
        if name not in wanted:
            raise LawError(f"gain {name}", f"has a start but is not among those to move, {wanted}")
    if not wanted:
        raise LawError(f"law {file.name}", "declares no free gain (parameters.NAME.free)")
    gains = []
    for name in wanted:
        p = declared[name]
        assert p.free is not None
        low, high = p.free
        if not (np.isfinite(p.free).all() and low < high):
            raise LawError(
                f"parameters.{name}.free", f"[{low:g}, {high:g}] must be finite and ascending"
            )
        value = (start or {}).get(name, p.value)
        if not low <= value <= high:
            raise LawError(f"gain {name}", f"start {value:g} lies outside [{low:g}, {high:g}]")
        gains.append(FreeGain(name, value, low, high))
    return tuple(gains)


def _generic(gain: FreeGain, k: int) -> float:
    """The k-th gain slightly away from its start, by a relative amount that no other gain has."""
    share = 1e-3 * (0.5 + (k + 1) * _GOLDEN % 1.0)
    step = share * (abs(gain.start) or min(1.0, abs(gain.low), abs(gain.high)))
    moved = gain.start + step if gain.start + step <= gain.high else gain.start - step
    return min(max(moved, gain.low), gain.high)


class GainedLaw:
    """A law around an operating point, as a function of its free gains.

    Args:
        file: the law file.
        gains: which of its parameters are free.
        op, ref, dc_control: as for ``gfm_design.model.linear.linearise_law``.
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
        self._off_start = np.array([_generic(g, k) for k, g in enumerate(self.gains)])
        self._affine = self._try_affine()

    @property
    def is_affine(self) -> bool:
        """Whether the law's matrices are affine in the gains, as the paper's G and K require."""
        return self._affine is not None

    def named(self, values: Vector) -> dict[str, float]:
        """The gains by name, tied parameters included."""
        free = {g.name: float(v) for g, v in zip(self.gains, values, strict=True)}
        return tied(self.file, free)

    def __call__(self, values: Vector) -> LinearLaw:
        """The law at gains of shape (n,), or the laws at gains of shape (N, n) on a leading axis.

        Gains that give no valid law give matrices of nan.
        """
        if self._affine is None:
            many = self._many(np.atleast_2d(values))
            return many if np.ndim(values) == 2 else LinearLaw(*(m[0] for m in many.matrices))
        base, slopes = self._affine
        flat, ends = base + values @ slopes, np.cumsum([0, *map(math.prod, self._shapes)])
        parts = [flat[..., a:b] for a, b in pairwise(ends)]
        return LinearLaw(
            *(m.reshape(*flat.shape[:-1], *s) for m, s in zip(parts, self._shapes, strict=True))
        )

    def exact(self, values: Vector) -> LinearLaw:
        """The law as the runtime builds it, in lowest terms.

        Raises:
            LawError: the gains give no valid law.
        """
        law = build_law(self.file, self.named(values))
        return linearise_law(law, realise(law), self._op, self._ref, self._dc_control)

    def _many(self, values: Vector) -> LinearLaw:
        values = np.vstack([self._off_start, values])  # the first row determines the structure
        numbers = {n: np.full(len(values), p.value) for n, p in self.file.parameters.items()}
        numbers |= {g.name: values[:, k] for k, g in enumerate(self.gains)}
        for name, p in self.file.parameters.items():
            if p.tied is not None:
                numbers[name] = evaluate(f"parameters.{name}.tied", p.tied, numbers)
        law = closed_law(realise_each(self.file, numbers), self._map(numbers), self._dc_control)
        return LinearLaw(*(m[1:] for m in law.matrices))

    def _map(self, numbers: Mapping[str, Vector]) -> tuple[Vector, Vector]:
        """The error map's slopes; stacked, if it depends on free gains."""
        kind = self.file.error_map
        given = [v for v in (kind.R, kind.X) if v is not None]
        shape = next(iter(numbers.values())).shape
        impedance = [np.broadcast_to(evaluate("error_map", v, numbers), shape) for v in given]
        rows = np.array(impedance).reshape(len(given), *shape).T
        distinct, where = np.unique(rows, axis=0, return_inverse=True)
        slopes = [error_map_slopes(kind.type, row, self._op.y, self._ref) for row in distinct]
        r, y = (np.array(part) for part in zip(*slopes, strict=True))
        return (r[0], y[0]) if len(distinct) == 1 else (r[where], y[where])

    def _try_affine(self) -> tuple[Vector, Vector] | None:
        """The elements of all matrices at gains of zero (K,), and their slopes (n, K)."""
        at = np.array([g.start for g in self.gains])
        step = np.array([0.1 * (abs(g.start) or 1.0) for g in self.gains])
        laws = [self.exact(at), self.exact(at + 0.7 * step)]
        laws += [self.exact(at + aside) for aside in np.diag(step)]
        self._shapes, *others = (tuple(m.shape for m in law.matrices) for law in laws)
        if any(shapes != self._shapes for shapes in others):
            return None
        here, far, *sides = (np.concatenate([m.ravel() for m in o.matrices]) for o in laws)
        slopes = (np.array(sides).reshape(len(at), len(here)) - here) / step[:, None]
        misfit = np.abs(here + 0.7 * step @ slopes - far).max()
        if misfit > _AFFINE * max(1.0, np.abs(here).max()):
            return None
        return here - at @ slopes, slopes


_LINEAR = 0.01  # fraction of the bound up to which the coordinate is nearly linear


class Encoding:
    """Coordinates of gains, with their bounds.

    Attributes:
        start, low, high: coordinates of the start and of the bounds.
    """

    def __init__(self, gains: Sequence[FreeGain]) -> None:
        self._by_ratio = np.array([g.by_ratio for g in gains])
        self._bounds = np.array([[g.low for g in gains], [g.high for g in gains]])
        self._linear = _LINEAR * np.abs(self._bounds).max(axis=0)
        self.start = self.coordinates(np.array([g.start for g in gains]))
        self.low, self.high = (self.coordinates(b) for b in self._bounds)

    def values(self, point: Vector) -> Vector:
        """The gains at one point or at rows of points, clipped to the bounds."""
        held = np.clip(point, self.low, self.high)
        ratio = np.exp(np.where(self._by_ratio, held, 0.0))
        other = self._linear * np.sinh(np.where(self._by_ratio, 0.0, held))
        return np.clip(np.where(self._by_ratio, ratio, other), *self._bounds)

    def coordinates(self, values: Vector) -> Vector:
        """The coordinates of gains."""
        ratio = np.log(np.where(self._by_ratio, values, 1.0))
        return np.where(self._by_ratio, ratio, np.arcsinh(values / self._linear))


Columns = Mapping[str, NDArray[np.float64]]  # parameters by name, shape (N,) each


@np.errstate(all="ignore")  # such a row is not usable
def realise_each(file: LawFile, numbers: Columns) -> LawStateSpace:
    """The law at N sets of parameters: as ``realise``, every matrix with a leading axis of N.

    Rows in which an element is out of its bounds are NaN. In row 0 different factors must have
    different values.
    """
    good = np.ones(max(len(c) for c in numbers.values()), dtype=bool)
    cells: dict[str, dict[str, Element]] = {"phi": {}, "psi": {}}
    for matrix, of in (("phi", file.phi), ("psi", file.psi)):
        for key, specs in of.items():
            cells[matrix][key], fine = element_of(f"{matrix}_{key}", specs, numbers)
            good &= fine
    rows = []
    for i in range(NU):
        phi, psi = ([of.get(f"{i + 1}{j + 1}", ZERO) for j in range(NY)] for of in cells.values())
        rows.append(row_of(phi, psi, smooth=True))
    out = assemble(rows, [getattr(file.u_0, name) for name in U_NAMES])
    A, D_y = (np.broadcast_to(m, (len(good), *m.shape[-2:])).copy() for m in (out.A, out.D_y))
    A[~good], D_y[~good] = np.nan, np.nan
    return replace(out, A=A, D_y=D_y)
