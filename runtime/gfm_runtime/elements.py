"""The elements of Table II and their algebra.

P ``k``, I ``1/(Ts)``, D ``Ts``, PI ``k(1+1/(Ts))``, PD ``k(1+Ts)``, IF ``k/(Ts+1)``,
O ``k/(T^2 s^2+2T xi s+1)`` (note below Table II), and their sums and products; beside them any
fraction ``TF`` and any state space ``SS`` of one input and output.

An element is kept as a numerator polynomial over a *product of named factors*, not over an
expanded polynomial: ``s``, ``T s+1`` and ``T^2 s^2+2T xi s+1``. Equal factors are then recognised
exactly, which is what makes shared denominators share states (``gfm_runtime.realisation``) and
cancelling ones disappear. The denominator of a TF is one factor beside its integrators, so a TF
with the numbers of a named element is that element. Polynomials are tuples of coefficients in
ascending powers of s; those of a law file are in descending ones, as control programs have them.

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
#: One factor of a denominator, as its polynomial: (0,1) is s, (1,T) is Ts+1, (1,2Txi,T^2) is O's,
#: and that of a TF, whose constant coefficient is 1 too, may be longer.
Factor = tuple[Coefficient, ...]

INTEGRATOR: Factor = (0.0, 1.0)
_CANCELS = 1e-12  # relative remainder below which a factor divides a numerator
# Least and most of an element's numbers: times (s), a damping ratio, gains. What is outside is a
# typing error and would overflow.
_TIME, _DAMPING, _GAIN = (1e-9, 1e9), (5e-324, 1e12), (-1e12, 1e12)
_ANY = (-1e60, 1e60)  # a coefficient of an expanded polynomial
_BOUNDS = {"T": _TIME, "T_f": _TIME, "xi": _DAMPING} | dict.fromkeys(("num", "den", *"ABC"), _ANY)
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


def _text(polynomial: tuple[float, ...]) -> str:
    """A polynomial with the highest power first, e.g. ``0.1 s² - s + 3``."""
    text = ""
    for power, c in reversed([*enumerate(polynomial)]):
        if c != 0.0 or (not power and not text):
            s = "" if power == 0 else "s" if power == 1 else "s" + _digits(power)
            number = "" if s and abs(c) == 1.0 else f"{abs(c):.4g}"
            sign = (" - " if c < 0.0 else " + ") if text else "-" if c < 0.0 else ""
            text += sign + " ".join(part for part in (number, s) if part)
    return text


def _digits(power: int) -> str:
    return str(power).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _bracketed(text: str) -> str:
    return f"({text})" if " " in text else text


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

    def __str__(self) -> str:
        """Its formula with four digits, e.g. ``0.01/(0.167 s + 1)``."""
        above = _text(first(self.num))
        parts = [_text(first(factor)) for factor in self.den]
        if not parts:
            return above
        below = parts[0] if len(parts) == 1 else " ".join(_bracketed(part) for part in parts)
        above = _bracketed(above) if len([*filter(None, first(self.num))]) > 1 else above
        return f"{above}/{_bracketed(below)}"

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
                low, high = _BOUNDS.get(name, _GAIN)
                for one in _flat(value):
                    if np.ndim(one) == 0 and not low <= one <= high:
                        allowed = "> 0" if low == _DAMPING[0] else f"from {low:g} to {high:g}"
                        raise LawError(kind, f"{name} = {one:g} must be {allowed}")
            return function(**numbers)

        KINDS.setdefault(kind, {})[names] = checked
        return checked

    return register


def _flat(value: Any) -> list[Any]:
    """The numbers of a polynomial or a matrix, or a number alone."""
    return [c for part in value for c in _flat(part)] if isinstance(value, tuple) else [value]


def usable(numbers: Mapping[str, Any]) -> Any:
    """Whether the numbers of an element lie within their bounds, and a denominator is stable; of
    arrays, for each of the N."""
    inside: Any = True
    for name, value in numbers.items():
        low, high = _BOUNDS.get(name, _GAIN)
        for one in _flat(value):
            inside = inside & (low <= one) & (one <= high)
        if name == "den":
            inside = inside & stable(_split(value)[1])
    return inside


@np.errstate(all="ignore")  # what is not finite is not stable
def stable(factor: Factor) -> Any:
    """Whether all zeros of a polynomial have negative real parts; of arrays, for each of the N."""
    c = np.stack(np.broadcast_arrays(*factor), axis=-1)
    c = c / c[..., -1:]
    good = np.isfinite(c).all(axis=-1) & (c > 0.0).all(axis=-1)  # enough up to the second degree
    m = len(factor) - 1
    if m > 2:
        companion = np.zeros((*good.shape, m, m))
        companion[..., :-1, 1:] = np.eye(m - 1)
        companion[..., -1, :] = np.where(good[..., None], -c[..., :-1], 0.0)
        zeros = np.linalg.eigvals(companion)
        good = good & (zeros.real < -_CANCELS * np.abs(zeros)).all(axis=-1)
    return good


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


@element("TF")
def TF(num: Polynomial, den: Polynomial) -> Element:
    """Any fraction num(s)/den(s), coefficients in descending powers of s; stable, but for s."""
    zeros, rest = _split(den)
    if not len(rest):
        raise LawError("TF", "den is 0")
    if all(np.ndim(c) == 0 for c in rest) and not stable(rest):
        _refuse_unstable("TF", max(np.roots(rest[::-1]), key=lambda root: root.real), False)
    unit = rest[0]  # its constant coefficient becomes 1, as the named factors have it
    below = tuple(c / unit for c in rest)
    for power, c in enumerate(first(below)[1:], 1):
        if c and not _TIME[0] <= abs(c) ** (1 / power) <= _TIME[1]:
            raise LawError(
                "TF", f"den has a pole out of {1 / _TIME[1]:g} to {1 / _TIME[0]:g} rad/s"
            )
    factors = (INTEGRATOR,) * zeros + ((below,) if len(below) > 1 else ())
    return Element.of(tuple(c / unit for c in num[::-1]), factors)


def _split(den: Polynomial) -> tuple[int, Factor]:
    """A denominator in descending powers: how often it has the factor s, and the rest in ascending
    powers; the rest of 0 is ()."""
    below = _trimmed(den[::-1])
    zeros = 0
    while zeros < len(below) and not np.any(below[zeros]):
        zeros += 1
    return zeros, below[zeros:]


@element("TF")
def TF_gain(k: Coefficient, num: Polynomial, den: Polynomial) -> Element:
    """Any fraction times a gain, k num(s)/den(s)."""
    return P(k) * TF(num, den)


@element("SS")
def SS(
    A: tuple[tuple[float, ...], ...], B: tuple[float, ...], C: tuple[float, ...], D: float
) -> Element:
    """The state space dx/dt = A x + B e, u = C x + D e of one e and one u, A row by row."""
    n = len(A)
    if not all(len(part) == n for part in (*A, B, C)):
        raise LawError("SS", f"A has {n} rows, so that each of them, B and C must have {n} numbers")
    parts = (np.array(part, dtype=float) for part in (A, B, C, D))
    shapes = ((n, n), (n, 1), (1, n), (1, 1))
    return transfer(*(m.reshape(shape) for m, shape in zip(parts, shapes, strict=True)))[0][0]


if TYPE_CHECKING:
    Kind = str
else:
    Kind = Literal[(*KINDS, "sum")]

Matrix = NDArray[np.float64]
_INTEGRATES = 1e-9  # rad/s; a pole below is rounding's, T being at most 1e9 s
_SAME_POLE = 1e-7  # relative distance of a pole of a cell from one of A: a double one moves by 1e-8


def transfer(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> list[list[Element]]:
    """The elements of C (s - A)^-1 B + D, in lowest terms; equal poles are equal factors.

    Shapes: A (n,n), B (n,m), C (p,n), D (p,m); p rows of m elements.

    Raises:
        LawError: unstable, or the poles are too far apart for polynomials in double precision.
    """
    known = _poles(A)
    return [
        [_cell(A, B, j, C[i], float(D[i, j]), known) for j in range(B.shape[1])]
        for i in range(len(C))
    ]


def _poles(A: Matrix) -> NDArray[np.complex128]:
    poles = np.linalg.eigvals(A).astype(complex)
    poles[np.abs(poles) < _INTEGRATES] = 0.0
    return poles


def _cell(
    A: Matrix, B: Matrix, j: int, c: Matrix, D: float, known: NDArray[np.complex128]
) -> Element:
    """The element of column j; states that it does not reach or c does not see are left out
    (Kalman)."""
    A_c, c_c, b_c = _reached(A.T, c, B[:, j])
    A_m, b_m, c_m = _reached(A_c.T, b_c, c_c)
    poles = _poles(A_m)
    free = list(known)
    for k, pole in enumerate(poles):
        near = min(free, key=lambda other: abs(other - pole))
        if abs(near - pole) <= _SAME_POLE * abs(pole):
            free.remove(near)
            poles[k] = near
    for pole in poles:
        _refuse_unstable("SS", pole, pole == 0.0)
    below, above = (
        np.atleast_1d(np.poly(roots)).real
        for roots in (poles, np.linalg.eigvals(A_m - np.outer(b_m, c_m)))  # for 1 in place of D
    )
    above = above + (D - 1.0) * below
    x = b_m
    above[0] = D
    for k in range(1, len(above)):  # the first Markov parameters are 0 where poles outnumber zeros
        if above[:k].any() or abs(c_m @ x) > _CANCELS * np.linalg.norm(c_m) * np.linalg.norm(x):
            break
        above[k], x = 0.0, A_m @ x
    above = above / np.prod([-pole for pole in poles if pole != 0.0]).real
    factors = tuple(_factor(pole) for pole in poles if pole.imag >= 0.0)
    made = Element.of(tuple(map(float, above[::-1])), factors)
    size = 0.0  # beside what rounding leaves of B and C as a whole
    for w in np.abs(poles[poles != 0.0]) if poles.any() else [1.0]:
        X = np.linalg.solve(1j * w * np.eye(len(A)) - A, B)
        exact, got = c @ X[:, j] + D, made(1j * w)
        rounding = _CANCELS * np.linalg.norm(c) * np.linalg.norm(X)
        if abs(got - exact) > 1e-6 * abs(exact) + 1e-9 * abs(D) + rounding:
            raise LawError("SS", "its poles are too far apart for one element; split it")
        size = max(size, float(abs(got) - rounding))
    return made if size > 0.0 else ZERO


def _factor(pole: complex) -> Factor:
    """The factor of a real pole, or of a pair of complex ones."""
    if pole == 0.0:
        return INTEGRATOR
    size = abs(pole) ** 2
    return (1.0, -2.0 * pole.real / size, 1.0 / size) if pole.imag else (1.0, -1.0 / pole.real)


def _refuse_unstable(kind: str, pole: complex, fine: Any) -> None:
    """Raise LawError unless ``fine`` or the pole, rad/s, has a negative real part."""
    real = pole.real if abs(pole.real) > _CANCELS * abs(pole) else 0.0
    if not fine and real >= 0.0:
        if real == 0.0 and pole.imag:
            raise LawError(kind, f"undamped: poles at s = ±{abs(pole.imag):.3g}j rad/s")
        at = f"{complex(real, abs(pole.imag)):.3g}" if pole.imag else f"{real:.3g}"
        raise LawError(kind, f"unstable: a pole at s = {at} rad/s")


def _reached(A: Matrix, b: Matrix, c: Matrix) -> tuple[Matrix, Matrix, Matrix]:
    """A, b and c in the states that b reaches, by Arnoldi's method."""
    basis = np.zeros((len(A), 0))
    v, size = b, float(np.linalg.norm(b))
    while basis.shape[1] < len(A) and size > 0.0:
        r = v
        for _ in range(2):  # once more against rounding
            r = r - basis @ (basis.T @ r)
        norm = float(np.linalg.norm(r))
        if norm <= 1e-11 * size:
            break
        basis = np.column_stack([basis, r / norm])
        v = A @ basis[:, -1]
        size = float(np.linalg.norm(v))
    return basis.T @ A @ basis, basis.T @ b, basis.T @ c


@np.errstate(all="ignore")  # what is not finite is refused
def make(where: str, kind: Kind, numbers: Mapping[str, Any]) -> Element:
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
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        raise LawError(
            f"{where}, {kind}", "its numbers are too far apart to compute with"
        ) from None
    return made
