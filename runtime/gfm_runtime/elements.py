"""The elements of Table II and their algebra.

P ``k``, I ``1/(Ts)``, D ``Ts``, PI ``k(1+1/(Ts))``, PD ``k(1+Ts)``, IF ``k/(Ts+1)``,
O ``k/(T^2 s^2+2T xi s+1)`` (note below Table II), and their sums and products.

An element is kept as a numerator polynomial over a *product of named factors*, not over an
expanded polynomial: ``s``, ``T s+1`` and ``T^2 s^2+2T xi s+1``. Equal factors are then recognised
exactly, which is what makes shared denominators share states (``gfm_runtime.realisation``) and
cancelling ones disappear. Polynomials are tuples of coefficients in ascending powers of s.

A coefficient is a number, or an array of N numbers: the same element N times. The first of the N
then decides which factors are equal and which cancel. So one set of functions serves a law and a
search over thousands of gains.

A kind of element is a function here; ``element`` registers it for law files.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from gfm_runtime.errors import LawError

if TYPE_CHECKING:
    Coefficient = float
else:
    Coefficient = float | NDArray[np.float64]  # shape (N,)
Polynomial = tuple[Coefficient, ...]
#: One factor of a denominator, as its polynomial: (0,1) is s, (1,T) is Ts+1, (1,2Txi,T^2) is O's.
Factor = tuple[Coefficient, ...]

INTEGRATOR: Factor = (0.0, 1.0)
_CANCELS = 1e-12  # relative remainder below which a factor divides a numerator
# Least and most of an element's numbers: times (s), a damping ratio, gains. What is outside is a
# typing error and would overflow.
_TIME, _DAMPING, _GAIN = (1e-9, 1e9), (5e-324, 1e12), (-1e12, 1e12)
_BOUNDS = {"T": _TIME, "T_f": _TIME, "xi": _DAMPING}
#: by name in a law file: by the names of the numbers that it takes, the function
KINDS: dict[str, dict[tuple[str, ...], Callable[..., Element]]] = {}


def first(polynomial: Sequence[Coefficient]) -> tuple[float, ...]:
    """The coefficients of the first of N polynomials, or of a single one."""
    return tuple(c if isinstance(c, float) else float(np.ravel(c)[0]) for c in polynomial)


def poly_mul(a: Sequence[Coefficient], b: Sequence[Coefficient]) -> Polynomial:
    """Product of two polynomials in ascending powers."""
    out: list[Coefficient] = [0.0] * (len(a) + len(b) - 1)
    for i, one in enumerate(a):
        for j, other in enumerate(b):
            out[i + j] = out[i + j] + one * other
    return tuple(out)


def poly_add(a: Sequence[Coefficient], b: Sequence[Coefficient]) -> Polynomial:
    """Sum of two polynomials in ascending powers."""
    size = max(len(a), len(b))
    longer, other = ([*p, *[0.0] * (size - len(p))] for p in (a, b))
    return tuple(c + d for c, d in zip(longer, other, strict=True))


def _divide(a: Polynomial, factor: Factor) -> Polynomial | None:
    """a / factor where factor divides the first a (to rounding), else None.

    Divides in s/w, w the factor's own frequency, so that rounding is judged alike at any T; w is
    rounded to a power of two, which is exact.
    """
    order, own = len(factor) - 1, first(factor)
    if len(a) <= order:
        return None
    w = 2.0 ** round(math.log2(own[0] / own[-1]) / order) if own[0] > 0.0 else 1.0
    scaled = [c * w**k for k, c in enumerate(a)]
    lead = factor[-1] * w**order
    below = [c * w**k / lead for k, c in enumerate(factor[:-1])]
    rest = list(scaled)
    for at in reversed(range(order, len(a))):
        for k in range(order):
            rest[at - order + k] = rest[at - order + k] - below[k] * rest[at]
    if max(map(abs, first(rest[:order]))) > _CANCELS * max(map(abs, first(scaled))):
        return None
    return tuple(c / lead / w**k for k, c in enumerate(rest[order:]))


def _trimmed(polynomial: Sequence[Coefficient]) -> Polynomial:
    """Without highest powers that are 0."""
    size = len(polynomial)
    while size > 1 and not np.any(polynomial[size - 1]):
        size -= 1
    return tuple(polynomial[:size])


@dataclass(frozen=True)
class Element:
    """A scalar transfer function num(s) / prod(den)."""

    num: Polynomial  #: numerator coefficients, ascending powers of s
    den: tuple[Factor, ...] = ()  #: the denominator's factors, sorted; empty for a constant

    @staticmethod
    def of(num: Sequence[Coefficient], den: Sequence[Factor] = ()) -> Element:
        """Build in lowest terms: factors that the numerator contains are cancelled."""
        rest: list[Factor] = []
        top = _trimmed(num)
        if not any(map(np.any, top)):
            return ZERO
        for factor in den:
            quotient = _divide(top, factor)
            if quotient is None:
                rest.append(factor)
            else:
                top = _trimmed(quotient)
        return Element(top, tuple(sorted(rest, key=first)))

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
    most: Counter[tuple[float, ...]] = Counter()
    for den in dens:
        most |= Counter(map(first, den))
    known = {first(factor): factor for den in dens for factor in den}
    return tuple(known[key] for key in sorted(most.elements()))


def over(element: Element, den: tuple[Factor, ...]) -> Polynomial:
    """Numerator of the element when written over the larger denominator ``den``."""
    num, own = element.num, Counter(map(first, element.den))
    for factor in den:
        if own[first(factor)] > 0:
            own[first(factor)] -= 1
        else:
            num = poly_mul(num, factor)
    return num


ZERO = Element((0.0,))


def element(kind: str) -> Callable[[Callable[..., Element]], Callable[..., Element]]:
    """Decorator: register a function of numbers as a kind of element, and check its numbers.

    The function then raises LawError for a number out of bounds; of arrays see ``usable``.
    """

    def register(function: Callable[..., Element]) -> Callable[..., Element]:
        names = tuple(inspect.signature(function).parameters)

        @functools.wraps(function)
        def checked(*values: Coefficient, **named: Coefficient) -> Element:
            numbers = dict(zip(names, values, strict=False)) | named
            for name, value in numbers.items():
                if np.ndim(value) == 0 and not usable({name: value}):
                    low, high = _BOUNDS.get(name, _GAIN)
                    allowed = "> 0" if low == _DAMPING[0] else f"from {low:g} to {high:g}"
                    raise LawError(kind, f"{name} = {value:g} must be {allowed}")
            return function(**numbers)

        KINDS.setdefault(kind, {})[names] = checked
        return checked

    return register


def usable(numbers: Mapping[str, Coefficient]) -> Any:
    """Whether the numbers of an element lie within their bounds; of arrays, for each of the N."""
    inside: Any = True
    for name, value in numbers.items():
        low, high = _BOUNDS.get(name, _GAIN)
        inside &= (low <= value) & (value <= high)
    return inside


@element("P")
def P(k: Coefficient) -> Element:
    """Proportional, k."""
    return Element.of((k,))


@element("I")
def I(T: Coefficient) -> Element:  # noqa: E743 - the paper's letter
    """Integral, 1/(Ts); T in s."""
    return Element.of((1.0 / T,), (INTEGRATOR,))


@element("I")
def I_gain(k_i: Coefficient) -> Element:
    """Integral, k_i/s; k_i in 1/s."""
    return Element.of((k_i,), (INTEGRATOR,))


@element("D")
def D(T: Coefficient) -> Element:
    """Derivative, Ts; T in s. Improper alone: multiply by an IF or give a filter."""
    return Element.of((0.0, T))


@element("PI")
def PI(k: Coefficient, T: Coefficient) -> Element:
    """Proportional-integral, k(1+1/(Ts)); T in s."""
    return Element.of((k / T, k), (INTEGRATOR,))


@element("PI")
def PI_gains(k: Coefficient, k_i: Coefficient) -> Element:
    """Proportional-integral, k + k_i/s, the form the paper prints its gains in; k_i in 1/s."""
    return Element.of((k_i, k), (INTEGRATOR,))


@element("PD")
def PD(k: Coefficient, T: Coefficient) -> Element:
    """Proportional-derivative, k(1+Ts); T in s. Improper alone, as D."""
    return Element.of((k, k * T))


@element("IF")
def IF(k: Coefficient, T: Coefficient) -> Element:
    """Inertia factor (first-order lag), k/(Ts+1); T in s."""
    return Element.of((k,), ((1.0, T),))


@element("O")
def O(k: Coefficient, T: Coefficient, xi: Coefficient) -> Element:  # noqa: E743 - paper's letter
    """Oscillatory factor, k/(T^2 s^2+2T xi s+1); T in s, xi damping ratio."""
    return Element.of((k,), ((1.0, 2.0 * T * xi, T * T),))


if TYPE_CHECKING:
    Kind = str
else:
    Kind = Literal[tuple(KINDS)]


def make(where: str, kind: Kind, numbers: Mapping[str, Coefficient]) -> Element:
    """An element by its kind and its numbers; ``T_f`` multiplies any kind by 1/(T_f s + 1).

    Raises:
        LawError: naming ``where``: the kind takes other numbers, or one is out of bounds.
    """
    own = {name: value for name, value in numbers.items() if name != "T_f"}
    forms = {frozenset(names): function for names, function in KINDS[kind].items()}
    if frozenset(own) not in forms:
        known = " or ".join(sorted(str(sorted(names)) for names in forms))
        raise LawError(where, f"{kind} takes {known}, not {sorted(own)}")
    try:
        made = forms[frozenset(own)](**own)
        if "T_f" in numbers:
            where = f"{where}.T_f"
            made = made * IF(1.0, numbers["T_f"])
    except LawError as problem:
        raise LawError(f"{where}, {problem.where}", problem.why) from None
    return made
