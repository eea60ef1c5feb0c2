"""A law file's state space for many sets of gains at once.

``gfm_runtime.realisation`` builds one law with all checks, in some milliseconds; a search asks for
thousands. This module multiplies the same elements for a whole population in one pass: every
coefficient is a column of N numbers. Row 0 decides which factors are shared and which cancel, so
its gains must not make two different factors equal.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.elements import INTEGRATOR, K_MAX, T_MAX, T_MIN, Element
from gfm_runtime.expressions import evaluate_each
from gfm_runtime.lawfile import ElementSpec, LawFile
from gfm_runtime.realisation import LawStateSpace, Row, assemble, observer_form, powers
from gfm_runtime.signals import NU, NY, U_NAMES

Matrix = NDArray[np.float64]
Columns = Mapping[str, Matrix]  # parameters by name, shape (N,) each


@dataclass(frozen=True)
class _Rows:
    """An element N times: num (N, degree + 1) over the product of den, (N, 2 or 3) each."""

    num: Matrix
    den: tuple[Matrix, ...] = ()

    def __mul__(self, other: _Rows) -> _Rows:
        return _Rows(_product(self.num, other.num), self.den + other.den).reduced()

    def reduced(self) -> _Rows:
        """Without the factors that cancel in row 0."""
        kept = Counter(Element.of(self.num[0], [_key(f) for f in self.den]).den)
        num, den = self.num, []
        for factor in self.den:
            if kept[_key(factor)] > 0:
                kept[_key(factor)] -= 1
                den.append(factor)
            else:
                num = _quotient(num, factor)
        return _Rows(num, tuple(den))

    def over(self, den: tuple[Matrix, ...]) -> Matrix:
        """Numerator over the larger denominator ``den``."""
        own, num = Counter(map(_key, self.den)), self.num
        for factor in den:
            if own[_key(factor)] > 0:
                own[_key(factor)] -= 1
            else:
                num = _product(num, factor)
        return num


def _key(factor: Matrix) -> tuple[float, ...]:
    return tuple(factor[0].tolist())


def _product(a: Matrix, b: Matrix) -> Matrix:
    out = np.zeros((len(a), a.shape[1] + b.shape[1] - 1))
    for k in range(b.shape[1]):
        out[:, k : k + a.shape[1]] += a * b[:, [k]]
    return out


def _quotient(a: Matrix, factor: Matrix) -> Matrix:
    """a over a factor that divides it."""
    rest, order = a.copy(), factor.shape[1] - 1
    out = np.zeros((len(a), a.shape[1] - order))
    for k in reversed(range(out.shape[1])):
        out[:, k] = rest[:, k + order] / factor[:, -1]
        rest[:, k : k + order + 1] -= out[:, [k]] * factor
    return out


class _Builder:
    """Elements from their specifications; ``usable`` says which rows keep the elements' bounds."""

    def __init__(self, numbers: Columns, count: int) -> None:
        self._numbers, self._count = numbers, count
        self.usable = np.ones(count, dtype=bool)

    def column(self, where: str, value: float | str) -> Matrix:
        """A number or expression, shape (N,)."""
        return np.broadcast_to(evaluate_each(where, value, self._numbers), (self._count,))

    def cell(self, where: str, specs: list[ElementSpec]) -> _Rows:
        """The product of a cell's factors."""
        product = _Rows(np.ones((self._count, 1)))
        for spec in specs:
            product = product * self._element(where, spec)
            if spec.T_f is not None:
                lag = self.column(f"{where}.T_f", spec.T_f)
                self.usable &= (lag >= T_MIN) & (lag <= T_MAX)
                product = product * _Rows(self._stack(1.0), (self._stack(1.0, lag),))
        return product

    def _element(self, where: str, spec: ElementSpec) -> _Rows:
        given = spec.model_dump(exclude={"type", "T_f"}, exclude_none=True)
        n = {name: self.column(f"{where}.{name}", value) for name, value in given.items()}
        for name in {"k", "k_i"} & set(n):
            self.usable &= np.abs(n[name]) <= K_MAX
        k, T = n.get("k", np.zeros(self._count)), n.get("T", np.ones(self._count))
        self.usable &= (T >= T_MIN) & (T <= T_MAX)
        integrator = (self._stack(*INTEGRATOR),)
        match spec.type:
            case "P":
                return _Rows(self._stack(k))
            case "I" | "PI" if "k_i" in n:
                return _Rows(self._stack(n["k_i"], k), integrator).reduced()
            case "I":
                return _Rows(self._stack(1.0 / T), integrator)
            case "PI":
                return _Rows(self._stack(k / T, k), integrator)
            case "D":
                return _Rows(self._stack(0.0, T))
            case "PD":
                return _Rows(self._stack(k, k * T))
            case "IF":
                return _Rows(self._stack(k), (self._stack(1.0, T),))
            case _:  # "O"
                self.usable &= n["xi"] > 0.0
                return _Rows(self._stack(k), (self._stack(1.0, 2.0 * T * n["xi"], T * T),))

    def _stack(self, *coefficients: Matrix | float) -> Matrix:
        return np.stack([np.broadcast_to(c, (self._count,)) for c in coefficients], axis=1)


@np.errstate(all="ignore")  # such a row is not usable
def realise_each(file: LawFile, numbers: Columns) -> LawStateSpace:
    """The law at N sets of parameters: as ``realise``, every matrix with a leading axis of N.

    Rows in which an element is out of its bounds are NaN. In row 0 different factors must have
    different values.
    """
    count = max(len(c) for c in numbers.values())
    builder = _Builder(numbers, count)
    rows = [_row(file, i, builder) for i in range(NU)]
    out = assemble(rows, [getattr(file.u_0, name) for name in U_NAMES])
    out.A[~builder.usable], out.D_y[~builder.usable] = np.nan, np.nan
    return out


def _row(file: LawFile, i: int, builder: _Builder) -> Row:
    """Observer form of row i, every matrix with a leading axis of N."""
    cells = {
        (matrix, int(key[1]) - 1): builder.cell(f"{matrix}_{key}", specs)
        for matrix, of in (("phi", file.phi), ("psi", file.psi))
        for key, specs in of.items()
        if key[0] == str(i + 1)
    }
    most: Counter[tuple[float, ...]] = Counter()
    for cell in cells.values():
        most |= Counter(map(_key, cell.den))
    known = {_key(f): f for cell in cells.values() for f in cell.den}
    den = tuple(known[key] for key in sorted(most.elements()))
    d = np.ones((len(builder.usable), 1))
    for factor in den:
        d = _product(d, factor)
    on_r, on_y = np.zeros((2, len(d), NY, d.shape[1]))
    for (matrix, j), cell in cells.items():
        num = cell.over(den)[:, : d.shape[1]] / d[:, [-1]]
        on_y[:, j, : num.shape[1]] -= num
        if matrix == "phi":
            on_r[:, j, : num.shape[1]] += num
    monic = d / d[:, [-1]]
    # not rounded to powers of two as in ``realise``: the matrices are to be smooth in the gains
    return observer_form(monic, on_r, on_y, powers(monic))
