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

_GOLDEN = (5.0**0.5 - 1.0) / 2.0  # irrational: no two of its multiples are equal modulo 1
_AFFINE = 1e-9  # relative misfit at a point away from the base that still counts as affine


@dataclass(frozen=True)
class FreeGain:
    """A parameter of a law file that synthesis may choose, within [low, high]."""

    name: str
    start: float
    low: float
    high: float

    @property
    def logarithmic(self) -> bool:
        """Whether synthesis searches its logarithm: its bounds keep it positive."""
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
    chosen = [n for n in declared if only is None or n in only]
    for name in start or {}:
        if name not in chosen:
            raise LawError(f"gain {name}", f"has a start but is not among those to move, {chosen}")
    if not chosen:
        raise LawError(f"law {file.name}", "declares no free gain (parameters.NAME.free)")
    gains = []
    for name in chosen:
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


def _off_start(gain: FreeGain, k: int) -> float:
    """The k-th gain slightly away from its start, by a relative amount that no other gain has."""
    share = 1e-3 * (0.5 + (k + 1) * _GOLDEN % 1.0)
    step = share * (abs(gain.start) or min(1.0, abs(gain.low), abs(gain.high)))
    value = gain.start + step if gain.start + step <= gain.high else gain.start - step
    return min(max(value, gain.low), gain.high)


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
        self._off_start = np.array([_off_start(g, k) for k, g in enumerate(self.gains)])
        self._affine = self._try_affine()

    @property
    def is_affine(self) -> bool:
        """Whether the law's matrices are affine in the gains, as the paper's G and K require."""
        return self._affine is not None

    def named(self, values: Vector) -> dict[str, float]:
        """The gains of ``values``, shape (n,), by name, and the parameters tied to them."""
        free = {g.name: float(v) for g, v in zip(self.gains, values, strict=True)}
        return tied(self.file, free)

    def __call__(self, values: Vector) -> LinearLaw:
        """The law at gains of shape (n,), or the laws at gains of shape (N, n) on a leading axis.

        The matrices are NaN where the gains give no valid law.
        """
        if self._affine is None:
            many = self._realise(np.atleast_2d(values))
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

    def _realise(self, values: Vector) -> LinearLaw:
        """The laws at gains of shape (N, n), each built from the file."""
        values = np.vstack([self._off_start, values])  # the first row determines the structure
        numbers = {n: np.full(len(values), p.value) for n, p in self.file.parameters.items()}
        numbers |= {g.name: values[:, k] for k, g in enumerate(self.gains)}
        for name, p in self.file.parameters.items():
            if p.tied is not None:
                numbers[name] = evaluate(f"parameters.{name}.tied", p.tied, numbers)
        law = closed_law(realise_each(self.file, numbers), self._map(numbers), self._dc_control)
        return LinearLaw(*(m[1:] for m in law.matrices))

    def _map(self, numbers: Mapping[str, Vector]) -> tuple[Vector, Vector]:
        """The error map's slopes; with a leading axis of N, if it depends on free gains."""
        kind = self.file.error_map
        parts = [v for v in (kind.R, kind.X) if v is not None]
        shape = next(iter(numbers.values())).shape
        impedance = [np.broadcast_to(evaluate("error_map", v, numbers), shape) for v in parts]
        rows = np.array(impedance).reshape(len(parts), *shape).T
        distinct, where = np.unique(rows, axis=0, return_inverse=True)
        slopes = [error_map_slopes(kind.type, row, self._op.y, self._ref) for row in distinct]
        r, y = (np.array(slope) for slope in zip(*slopes, strict=True))
        return (r[0], y[0]) if len(distinct) == 1 else (r[where], y[where])

    def _try_affine(self) -> tuple[Vector, Vector] | None:
        """The elements of all matrices at gains of zero, (K,), and their slopes, (n, K); None if
        the law is not affine in the gains."""
        start = np.array([g.start for g in self.gains])
        step = np.array([0.1 * (abs(g.start) or 1.0) for g in self.gains])
        laws = [self.exact(start), self.exact(start + 0.7 * step)]
        laws += [self.exact(start + one) for one in np.diag(step)]
        self._shapes, *others = (tuple(m.shape for m in law.matrices) for law in laws)
        if any(shapes != self._shapes for shapes in others):
            return None
        base, check, *at_steps = (np.concatenate([m.ravel() for m in o.matrices]) for o in laws)
        slopes = (np.array(at_steps).reshape(len(start), len(base)) - base) / step[:, None]
        misfit = np.abs(base + 0.7 * step @ slopes - check).max()
        if misfit > _AFFINE * max(1.0, np.abs(base).max()):
            return None
        return base - start @ slopes, slopes


_LINEAR = 0.01  # fraction of the larger bound up to which asinh is nearly linear


class Encoding:
    """The coordinates in which a search moves gains: the logarithm of a gain that stays positive,
    the inverse hyperbolic sine of any other. Equal steps then change large gains by like ratios.

    Attributes:
        start, low, high: coordinates of the start and of the bounds, shape (n,).
    """

    def __init__(self, gains: Sequence[FreeGain]) -> None:
        self._logarithmic = np.array([g.logarithmic for g in gains])
        self._bounds = np.array([[g.low for g in gains], [g.high for g in gains]])
        self._linear = _LINEAR * np.abs(self._bounds).max(axis=0)
        self.start = self.coordinates(np.array([g.start for g in gains]))
        self.low, self.high = (self.coordinates(b) for b in self._bounds)

    def values(self, point: Vector) -> Vector:
        """The gains at coordinates of shape (n,) or (N, n), clipped to the bounds."""
        inside = np.clip(point, self.low, self.high)
        ratio = np.exp(np.where(self._logarithmic, inside, 0.0))
        other = self._linear * np.sinh(np.where(self._logarithmic, 0.0, inside))
        return np.clip(np.where(self._logarithmic, ratio, other), *self._bounds)

    def coordinates(self, values: Vector) -> Vector:
        """The coordinates of gains, of the same shape."""
        ratio = np.log(np.where(self._logarithmic, values, 1.0))
        return np.where(self._logarithmic, ratio, np.arcsinh(values / self._linear))


Columns = Mapping[str, NDArray[np.float64]]  # parameters by name, shape (N,) each


@np.errstate(all="ignore")  # rows out of bounds may divide by 0; they become NaN below
def realise_each(file: LawFile, numbers: Columns) -> LawStateSpace:
    """The law at N sets of parameters: as ``realise``, every matrix with a leading axis of N.

    Rows in which an element is out of its bounds are NaN. In row 0 different factors must have
    different values.
    """
    valid = np.ones(max(len(c) for c in numbers.values()), dtype=bool)
    cells: dict[str, dict[str, Element]] = {"phi": {}, "psi": {}}
    for matrix, of in (("phi", file.phi), ("psi", file.psi)):
        for key, specs in of.items():
            cells[matrix][key], within = element_of(f"{matrix}_{key}", specs, numbers)
            valid &= within
    rows = []
    for i in range(NU):
        phi, psi = ([of.get(f"{i + 1}{j + 1}", ZERO) for j in range(NY)] for of in cells.values())
        rows.append(row_of(phi, psi, smooth=True))
    out = assemble(rows, [getattr(file.u_0, name) for name in U_NAMES])
    A, D_y = (np.broadcast_to(m, (len(valid), *m.shape[-2:])).copy() for m in (out.A, out.D_y))
    A[~valid], D_y[~valid] = np.nan, np.nan
    return replace(out, A=A, D_y=D_y)
