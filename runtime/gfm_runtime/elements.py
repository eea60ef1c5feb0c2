"""The elements of Table II and their algebra.

P ``k``, I ``1/(Ts)``, D ``Ts``, PI ``k(1+1/(Ts))``, PD ``k(1+Ts)``, IF ``k/(Ts+1)``,
O ``k/(T^2 s^2+2T xi s+1)`` (note below Table II), and their sums and products.

An element is kept as a numerator polynomial over a *product of named factors*, not over an
expanded polynomial: ``s``, ``T s+1`` and ``T^2 s^2+2T xi s+1``. Equal factors are then recognised
exactly, which is what makes shared denominators share states (``gfm_runtime.realisation``) and
cancelling ones disappear. Polynomials are coefficient tuples in ascending powers of s.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polydiv, polyval
from numpy.polynomial.polyutils import trimseq

from gfm_runtime.errors import LawError

Polynomial = tuple[float, ...]
#: One factor of a denominator, as its polynomial: (0,1) is s, (1,T) is Ts+1, (1,2Txi,T^2) is O's.
Factor = tuple[float, ...]

INTEGRATOR: Factor = (0.0, 1.0)
_CANCELS = 1e-12  # relative remainder below which a factor divides a numerator
T_MIN, T_MAX = 1e-9, 1e9  # s; a value outside is a typing error and would overflow
K_MAX = 1e12


def poly_mul(a: Sequence[float], b: Sequence[float]) -> Polynomial:
    """Product of two polynomials in ascending powers."""
    return tuple(float(c) for c in np.convolve(a, b))


def poly_add(a: Sequence[float], b: Sequence[float]) -> Polynomial:
    """Sum of two polynomials in ascending powers."""
    out = np.zeros(max(len(a), len(b)))
    out[: len(a)] += a
    out[: len(b)] += b
    return tuple(float(c) for c in out)


def _divide(a: Polynomial, factor: Factor) -> Polynomial | None:
    """a / factor where factor divides a (to rounding), else None.

    Divides in s/w, w the factor's own frequency, so that rounding is judged alike at any T; w is
    rounded to a power of two, which is exact.
    """
    order = len(factor) - 1
    if len(a) <= order:
        return None
    w = 2.0 ** round(math.log2(factor[0] / factor[-1]) / order) if factor[0] > 0.0 else 1.0
    scaled = np.asarray(a) * w ** np.arange(len(a))
    divisor = np.asarray(factor) * w ** np.arange(order + 1)
    quotient, remainder = (np.asarray(c) for c in polydiv(scaled, divisor))
    if np.max(np.abs(remainder)) > _CANCELS * np.max(np.abs(scaled)):
        return None
    return tuple(float(c) for c in quotient / w ** np.arange(len(quotient)))


@dataclass(frozen=True)
class Element:
    """A scalar transfer function num(s) / prod(den).

    Attributes:
        num: numerator coefficients, ascending powers of s.
        den: the denominator's factors, sorted; empty for a constant.
    """

    num: Polynomial
    den: tuple[Factor, ...] = ()

    @staticmethod
    def of(num: Sequence[float], den: Sequence[Factor] = ()) -> Element:
        """Build in lowest terms: factors that the numerator contains are cancelled."""
        rest: list[Factor] = []
        top: Polynomial = trimseq(tuple(float(c) for c in num))
        if all(c == 0.0 for c in top):
            return Element((0.0,))
        for factor in den:
            quotient = _divide(top, factor)
            if quotient is None:
                rest.append(factor)
            else:
                top = trimseq(quotient)
        return Element(top, tuple(sorted(rest)))

    @property
    def is_zero(self) -> bool:
        """True for the zero element."""
        return self.num == (0.0,)

    @property
    def order(self) -> int:
        """Degree of the denominator."""
        return sum(len(f) - 1 for f in self.den)

    @property
    def is_proper(self) -> bool:
        """Degree of the numerator does not exceed the denominator's."""
        return len(self.num) - 1 <= self.order

    def __mul__(self, other: Element) -> Element:
        return Element.of(poly_mul(self.num, other.num), self.den + other.den)

    def __add__(self, other: Element) -> Element:
        den = union([self.den, other.den])
        num = poly_add(over(self, den), over(other, den))
        return Element.of(num, den)

    def __neg__(self) -> Element:
        return Element(tuple(-c for c in self.num), self.den)

    def __call__(self, s: complex) -> complex:
        """Value at the complex frequency s [rad/s]."""
        below = math.prod(complex(polyval(s, factor)) for factor in self.den)
        return complex(polyval(s, self.num)) / below


def union(dens: Sequence[tuple[Factor, ...]]) -> tuple[Factor, ...]:
    """Least common denominator of several factor lists: each factor at its highest multiplicity."""
    most: Counter[Factor] = Counter()
    for den in dens:
        most |= Counter(den)
    return tuple(sorted(most.elements()))


def over(element: Element, den: tuple[Factor, ...]) -> Polynomial:
    """Numerator of the element when written over the larger denominator ``den``."""
    num = element.num
    for factor in (Counter(den) - Counter(element.den)).elements():
        num = poly_mul(num, factor)
    return num


ZERO = Element((0.0,))


def _gain(kind: str, **values: float) -> None:
    for name, value in values.items():
        if not abs(value) <= K_MAX:
            raise LawError(kind, f"{name} = {value:g} must lie within +-{K_MAX:g}")


def _time(kind: str, T: float) -> None:
    if T <= 0.0:
        raise LawError(kind, f"T = {T:g} s must be > 0 (else the element is unstable)")
    if not T_MIN <= T <= T_MAX:
        raise LawError(kind, f"T = {T:g} s must lie in [{T_MIN:g}, {T_MAX:g}] s")


def P(k: float) -> Element:
    """Proportional, k."""
    _gain("P", k=k)
    return Element.of((k,))


def I(T: float) -> Element:  # noqa: E743 - the paper's letter
    """Integral, 1/(Ts); T in s."""
    _time("I", T)
    return Element.of((1.0 / T,), (INTEGRATOR,))


def D(T: float) -> Element:
    """Derivative, Ts; T in s. Improper alone: multiply by an IF or give a filter."""
    _time("D", T)
    return Element.of((0.0, T))


def PI(k: float, T: float) -> Element:
    """Proportional-integral, k(1+1/(Ts)); T in s."""
    _gain("PI", k=k)
    _time("PI", T)
    return Element.of((k / T, k), (INTEGRATOR,))


def PD(k: float, T: float) -> Element:
    """Proportional-derivative, k(1+Ts); T in s. Improper alone, as D."""
    _gain("PD", k=k)
    _time("PD", T)
    return Element.of((k, k * T))


def IF(k: float, T: float) -> Element:
    """Inertia factor (first-order lag), k/(Ts+1); T in s."""
    _gain("IF", k=k)
    _time("IF", T)
    return Element.of((k,), ((1.0, T),))


def O(k: float, T: float, xi: float) -> Element:  # noqa: E743 - the paper's letter
    """Oscillatory factor, k/(T^2 s^2+2T xi s+1); T in s, xi damping ratio > 0."""
    _gain("O", k=k, xi=xi)
    _time("O", T)
    if xi <= 0.0:
        raise LawError("O", f"xi = {xi:g} must be > 0 (else the element is unstable)")
    return Element.of((k,), ((1.0, 2.0 * T * xi, T * T),))
