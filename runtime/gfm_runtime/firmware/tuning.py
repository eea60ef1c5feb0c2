"""From a law's parameters to the coefficients of its tick, as arithmetic that C repeats to the bit.

The coefficients of a discretised law are rational functions of the parameters of its file. They
are written down once per law, by doing the arithmetic of ``gfm_runtime.realisation`` and
``gfm_runtime.tustin`` with numbers that remember what they were made of: the recorded operations in
float64 (+ - * /, sqrt, max) are evaluated here, and are the body of a function in C.

Comparisons of an element's numbers with their bounds are recorded too. Which states the law has,
and which factors are equal or cancel, are properties of the law's form: they are taken at values
beside those of the file, so that a gain of 0 is one that can be changed.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gfm_runtime.elements import INTEGRATOR, ZERO, Element, Polynomial, over, poly_mul, union
from gfm_runtime.errors import LawError
from gfm_runtime.expressions import evaluate
from gfm_runtime.firmware.c_text import literal, literals, plain
from gfm_runtime.firmware.translate import Expr, number
from gfm_runtime.inner import NONE
from gfm_runtime.law import cell_name
from gfm_runtime.lawfile import LawFile, element_of
from gfm_runtime.realisation import powers
from gfm_runtime.signals import NU, NY
from gfm_runtime.tustin import OMEGA_COLUMN, OMEGA_ROW

_DOES: dict[str, Callable[..., Any]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv,
    "neg": operator.neg, "sqrt": np.sqrt, "max": lambda a, b: b if a < b else a,
}  # fmt: skip
_ASIDE = 1e-3  # relative, of the values at which the law's form is taken
_MOST_POWER = 8
_LOOP, _ON_CIRCLE = 1.0 - 1e-9, 1.0 + 1e-9  # as gfm_runtime.tustin has them
#: fields of a law's record that follow from its parameters
FIELDS = ("error_parameters", "A", "B_r", "B_y", "C", "D_r", "D_y", "loop", "W",
          "E_r", "E_y", "F", "G")  # fmt: skip
SETS = 3  #: sets of gains in golden rows


def _both_ways(op: str) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any], Any]]:
    """The methods of an operator, for the number at its left and for that at its right."""
    return (
        lambda one, other: one.book.of(op, one, other),
        lambda one, other: one.book.of(op, other, one),
    )


@dataclass(eq=False)
class TracedNumber:
    """A number that remembers its operation and operands; ``near`` is its value beside the file's,
    and ``book`` gets the comparisons."""

    op: str
    args: tuple[Any, ...]
    near: float
    book: _Book

    def __float__(self) -> float:
        return self.near

    def __format__(self, spec: str) -> str:
        return format(self.near, spec)

    __add__, __radd__ = _both_ways("+")
    __sub__, __rsub__ = _both_ways("-")
    __mul__, __rmul__ = _both_ways("*")
    __truediv__, __rtruediv__ = _both_ways("/")

    def __neg__(self) -> Any:
        return self.book.of("neg", self)

    def __pow__(self, power: Any) -> Any:
        if power == 0.5:
            return self.book.of("sqrt", self)
        if isinstance(power, TracedNumber) or power != int(power) or abs(power) > _MOST_POWER:
            raise LawError("**", f"only to the power of 0.5 and -{_MOST_POWER} to {_MOST_POWER}")
        product = functools.reduce(operator.mul, [self] * abs(int(power)), 1.0)
        return 1.0 / product if power < 0 else product

    def __rpow__(self, base: Any) -> Any:
        raise LawError("**", "takes no gain as its power")

    def __le__(self, other: Any) -> bool:
        return self.book.compare(self, other)

    def __ge__(self, other: Any) -> bool:
        return self.book.compare(other, self)


@dataclass
class _Book:
    """The operations, each once, and the comparisons a <= b that have to hold."""

    known: dict[tuple[Any, ...], TracedNumber] = field(default_factory=dict)
    holds: list[tuple[Any, Any]] = field(default_factory=list)

    def of(self, op: str, *args: Any) -> Any:
        """The result of an operation; what is a constant or an operand already is no new one."""
        a, b = args[0], args[-1]
        match op, _zero(a), _zero(b):
            case ("+", True, _) | ("*", _, True) if len(args) == 2:
                return b
            case ("+" | "-", _, True) | ("*" | "/", True, _):
                return a
            case ("-", True, _):
                return self.of("neg", b)
        if op in "*/" and isinstance(b, float) and abs(b) == 1.0:
            return a if b > 0 else self.of("neg", a)
        if op == "*" and isinstance(a, float) and abs(a) == 1.0:
            return b if a > 0 else self.of("neg", b)
        if op == "neg" and isinstance(a, TracedNumber) and a.op == "neg":
            return a.args[0]
        args = tuple(x if isinstance(x, TracedNumber) else float(x) for x in args)
        if not any(isinstance(x, TracedNumber) for x in args):
            return float(_DOES[op](*args))
        key = (op, *(id(x) if isinstance(x, TracedNumber) else x for x in args))
        if key not in self.known:
            near = float(_DOES[op](*map(np.float64, map(float, args))))
            self.known[key] = TracedNumber(op, args, near, self)
        return self.known[key]

    def compare(self, a: Any, b: Any) -> bool:
        """Whether a <= b holds beside the file's values; then it has to hold for all."""
        a, b = (x if isinstance(x, TracedNumber) else float(x) for x in (a, b))
        good = float(a) <= float(b)
        if good and (a, b) not in self.holds:
            self.holds.append((a, b))
        return good


def _zero(value: Any) -> bool:
    return not isinstance(value, TracedNumber) and value == 0.0


Matrix = list[list[Any]]


def _product(a: Matrix, b: Matrix) -> Matrix:
    columns = [*zip(*b, strict=True)]
    return [[_dot(row, column) for column in columns] for row in a]


def _dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total: Any = 0.0
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def _times(a: Matrix, factor: Any) -> Matrix:
    return [[factor * x for x in row] for row in a]


def _sum(a: Matrix, b: Matrix, sign: float = 1.0) -> Matrix:
    return [[x + sign * y for x, y in zip(p, q, strict=True)] for p, q in zip(a, b, strict=True)]


def _eye(n: int) -> Matrix:
    return [[float(i == j) for j in range(n)] for i in range(n)]


def _inverse(a: Matrix) -> Matrix:
    """By Gauss and Jordan; the pivots are the largest beside the file's values."""
    n = len(a)
    rows = [[*row, *unit] for row, unit in zip(a, _eye(n), strict=True)]
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(float(rows[i][k])))
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(n):
            if i != k and not _zero(rows[i][k]):
                factor = rows[i][k]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows]


def _poles(book: _Book, where: str, factor: Sequence[Any]) -> list[Any]:
    """The slowest real zero of a factor of a denominator, 1/s, or none."""
    if factor == INTEGRATOR:
        return [0.0]
    if len(factor) == 2:
        return [-factor[0] / factor[1]]
    if len(factor) == 3:
        c, b, a = factor
        square = b * b - 4.0 * a * c
        if float(square) < 0.0:
            book.compare(square, 0.0)
            return []
        book.compare(0.0, square)
        return [
            -2.0
            * c
            / (b + (square**0.5 if isinstance(square, TracedNumber) else math.sqrt(square)))
        ]
    if any(isinstance(c, TracedNumber) for c in factor):
        raise LawError(where, f"a denominator of degree {len(factor) - 1} has parameters in it")
    zeros = np.roots(factor[::-1])
    real = zeros[np.abs(zeros.imag) <= 1e-9 * np.abs(zeros)].real
    return [float(real.max())] if len(real) else []


@dataclass
class _Row:
    """A row of a law from tick to tick, as ``gfm_runtime.tustin`` has it."""

    A: Matrix
    B_r: Matrix
    B_y: Matrix
    c: list[Any]
    d_r: list[Any]
    d_y: list[Any]
    W: list[Any]
    E_r: Matrix
    E_y: Matrix
    f: list[Any]
    g: list[Any]


def _row(
    book: _Book,
    i: int,
    errors: Sequence[Element],
    feedbacks: Sequence[Element],
    T: Sequence[float],
    T_s: float,
    T_t: float,
) -> _Row:
    """A row in observer form, its states scaled by T, by Tustin; with what a limit and a change of
    law ask for."""
    where, half = cell_name("phi", (i, 0))[:-1] + "x", T_s / 2
    den = union([e.den for e in (*errors, *feedbacks)])
    d: Polynomial = (1.0,)
    lead: Any = 1.0
    for factor in den:
        d, lead = poly_mul(d, [c / factor[-1] for c in factor]), lead * factor[-1]
    m = len(d) - 1
    B, D = _inputs(errors, feedbacks, den, d, lead, T)
    if not m:
        return _Row([], [], [], [], D[0], D[1], [], [], [], [], [])
    A = [[0.0] * m for _ in range(m)]
    for k in range(m):
        A[k][0] = -1.0 * d[m - 1 - k] * (T[0] / T[k])
        if k + 1 < m:
            A[k][k + 1] = A[k][k + 1] + T[k + 1] / T[k]
    backward = _inverse(_sum(_eye(m), _times(A, half), -1.0))
    A_d = _product(backward, _sum(_eye(m), _times(A, half)))
    c = backward[0]
    for k in range(2):
        direct = _product([c], B[k])[0]
        D[k] = [x + half * y for x, y in zip(D[k], direct, strict=True)]
        B[k] = _times(_product(backward, B[k]), 2.0 * half)
    # of a limit: the slowest mode that does not swing, as its eigenvector in observer form
    poles = [p for factor in dict.fromkeys(den) for p in _poles(book, where, factor)]
    W: list[Any] = [0.0] * m
    if poles:
        s = 0.0 if any(map(_zero, poles)) else functools.reduce(
            lambda a, b: book.of("max", a, b), poles
        )  # fmt: skip
        v = _mode(d, s, T)
        W = [x / _dot(c, v) * min(1.0, T_s / T_t) for x in v]
    at_rest = _mode(d, 0.0, T) if INTEGRATOR in den else None
    E, f, g = _change(A_d, B, c, D, at_rest)
    return _Row(A_d, B[0], B[1], c, D[0], D[1], W, E[0], E[1], f, g)


def _inputs(
    errors: Sequence[Element],
    feedbacks: Sequence[Element],
    den: tuple[Polynomial, ...],
    d: Polynomial,
    lead: Any,
    T: Sequence[float],
) -> tuple[list[Matrix], list[list[Any]]]:
    """B and D of the references, and of the measurements, in continuous time."""
    m = len(d) - 1
    B: list[Matrix] = []
    D: list[list[Any]] = []
    for measured in (False, True):
        columns = []
        for error, feedback in zip(errors, feedbacks, strict=True):
            on = [*over(error, den), *[0.0] * (m + 1)][: m + 1]
            if measured:
                back = [*over(feedback, den), *[0.0] * (m + 1)][: m + 1]
                on = [-1.0 * x - y for x, y in zip(on, back, strict=True)]
            columns.append([x / lead for x in on])
        B.append([[(b[m - 1 - k] - b[m] * d[m - 1 - k]) / T[k] for b in columns] for k in range(m)])
        D.append([b[m] for b in columns])
    return B, D


def _change(
    A_d: Matrix,
    B: Sequence[Matrix],
    c: list[Any],
    D: Sequence[list[Any]],
    at_rest: list[Any] | None,
) -> tuple[list[Matrix], list[Any], list[Any]]:
    """E, f and g, which take the states at a change of law nearest to the rest state, with the
    output and its change right; ``at_rest``: the mode of an integrator."""
    m = len(c)
    move = _sum(A_d, _eye(m), -1.0)
    projector: Matrix = [[0.0] * m for _ in range(m)]
    if at_rest is not None:
        for k in range(m):
            projector[k][m - 1] = at_rest[k] / at_rest[m - 1]
    drazin = _sum(_inverse(_sum(projector, move, -1.0)), projector, -1.0)
    slope = _product([c], move)[0]
    f, g = [x / _dot(c, c) for x in c], [0.0] * m
    if m > 1:
        along = _dot(c, slope) / _dot(c, c)
        across = [y - along * x for x, y in zip(c, slope, strict=True)]
        g = [x / _dot(across, across) for x in across]
        f = [x - along * y for x, y in zip(f, g, strict=True)]
    E = []
    for b, direct in zip(B, D, strict=True):
        rest = _product(drazin, b)
        out, change, first = (_product([p], q)[0] for p, q in ((c, rest), (slope, rest), (c, b)))
        E.append(
            [
                [
                    rest[k][j] - f[k] * (out[j] + direct[j]) - g[k] * (change[j] + first[j])
                    for j in range(NY)
                ]
                for k in range(m)
            ]
        )
    return E, f, g


def _mode(d: Sequence[Any], s: Any, T: Sequence[float]) -> list[Any]:
    """The eigenvector of the observer form of the monic polynomial d at its zero s, scaled."""
    m = len(d) - 1
    v: list[Any] = [1.0]
    for k in range(m - 1):
        v.append(s * v[k] + d[m - 1 - k])
    return [x / t for x, t in zip(v, T, strict=True)]


class GainChanges:
    """What C needs to change a law's gains while it runs. Raises LawError: a law whose form follows
    from its parameters' values, or that is scheduled.

    Args:
        file: the law's file; its parameters but the tied ones are the gains.
        record: the law as ``pack_law`` gives it, with the values of the file.
        T_s: sampling time, s.
    """

    def __init__(self, file: LawFile, record: np.void, T_s: float) -> None:
        where = f"law {file.name!r}"
        if file.schedule is not None:
            raise LawError(where, "is scheduled: its gains change by themselves")
        inner = file.inner.model_dump() if file.inner and record["inner"] != NONE else {}
        if any(isinstance(v, str) and name in v for v in _flat(inner) for name in file.parameters):
            raise LawError(where, "has an inner stage that follows from its parameters")
        self.file, self.record, self.T_s = file, record, T_s
        self._book = book = _Book()
        self._nodes: dict[str, TracedNumber] = {}
        for k, (name, one) in enumerate(file.parameters.items()):
            near = one.value * (1.0 + _ASIDE * math.cos(k)) or _ASIDE * math.cos(k)
            if one.tied is None:
                self._nodes[name] = TracedNumber("gain", (name,), near, book)
        # as gfm_runtime.lawfile.tied has it, a tied parameter follows those that are not tied
        numbers = {name: one.value for name, one in file.parameters.items()} | self._nodes
        values: dict[str, Any] = dict(self._nodes)
        for name, one in file.parameters.items():
            if one.tied is not None:
                values[name] = evaluate(f"parameters.{name}.tied", one.tied, numbers)
        try:
            found = self._fields(values)
        except TypeError as problem:
            raise LawError(where, f"cannot be tuned while it runs: {problem}") from None
        #: what a coefficient is made of, and what it is in the file's law, in its precision
        self._made: list[Any] = []
        first: list[Any] = []
        #: by field, for each number its coefficient and whether it is that with the other sign
        self._places: dict[str, list[tuple[int, bool] | None]] = {}
        known: dict[Any, int] = {}
        for name, parts in found.items():
            self._places[name] = []
            for part, value in zip(parts, np.ravel(record[name]), strict=True):
                other = isinstance(part, TracedNumber) and part.op == "neg"
                what = part.args[0] if other else part
                if not isinstance(what, TracedNumber) and value == value.dtype.type(what):
                    self._places[name].append(None)
                    continue
                own = -value if other else value
                key = (id(what) if isinstance(what, TracedNumber) else what, own.tobytes())
                if key not in known:
                    known[key] = len(first)
                    self._made.append(what)
                    first.append(own)
                self._places[name].append((known[key], other))
        self.first = np.array(first, record["u_0"].dtype)
        self._steps = self._needed_steps()
        used = {id(a) for step in self._steps for a in step.args} | set(map(id, self._made))
        #: the gains that a coefficient follows, with their values in the file
        self.gains = {
            name: file.parameters[name].value
            for name, node in self._nodes.items()
            if id(node) in used
        }

    def _needed_steps(self) -> list[TracedNumber]:
        """The operations of the coefficients and of what has to hold, in their order."""
        ends = [*self._made, *(x for pair in self._book.holds for x in pair)]
        open_ones = [one for one in ends if isinstance(one, TracedNumber)]
        seen: set[int] = set()
        while open_ones:
            one = open_ones.pop()
            if id(one) not in seen:
                seen.add(id(one))
                open_ones += [a for a in one.args if isinstance(a, TracedNumber)]
        return [one for one in self._book.known.values() if id(one) in seen]

    def _values(self, gains: Mapping[str, float], steps: Iterable[TracedNumber]) -> Any:
        """What gives each number's value with these gains, the file's if not among them."""
        found: dict[int, Any] = {
            id(node): np.float64(gains.get(name, self.file.parameters[name].value))
            for name, node in self._nodes.items()
        }

        def value(one: Any) -> Any:
            return found[id(one)] if isinstance(one, TracedNumber) else np.float64(one)

        for step in steps:
            found[id(step)] = _DOES[step.op](*map(value, step.args))
        return value

    @np.errstate(all="ignore")
    def record_of(self, gains: Mapping[str, float]) -> np.void:
        """The law's record with other gains, in the bits that C gives it. Raises LawError: a gain
        that is out of its range, or gains that together give no law."""
        for name, value in gains.items():
            low, high = self.ranges[name]
            if not low <= value <= high:
                raise LawError(name, f"{value:g} must be from {low:g} to {high:g}")
        value = self._values(gains, self._steps)
        new = np.array([value(one) for one in self._made]).astype(self.first.dtype)
        holds = all(value(a) <= value(b) for a, b in self._book.holds)
        if not (holds and np.isfinite(new).all()):
            raise LawError(f"law {self.file.name!r}", "these gains together give no stable law")
        out = self.record.copy()
        for name, places in self._places.items():
            flat = np.ravel(out[name]).copy()
            for k, place in enumerate(places):
                if place is not None:
                    flat[k] = -new[place[0]] if place[1] else new[place[0]]
            out[name] = flat.reshape(out[name].shape)
        return out

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Of the gains: the range in which the file lets a synthesis move it, or any number."""
        largest = float(np.finfo(np.float64).max)
        return {name: self.file.parameters[name].free or (-largest, largest) for name in self.gains}

    def sets(self, seed: int) -> list[dict[str, float]]:
        """Sets of gains for golden rows: the file's, and others within 10 percent that can be."""
        draw, out = np.random.PCG64(seed), [dict(self.gains)]
        for _ in range(100 * SETS):
            if len(out) == SETS:
                break
            one = {}
            for name, value in self.gains.items():
                share = (int(draw.random_raw()) >> 11) * 2.0**-53
                low, high = self.ranges[name]
                one[name] = min(max(value * (0.9 + 0.2 * share) or 0.01 * share, low), high)
            with contextlib.suppress(LawError):
                self.record_of(one)
                out.append(one)
        return out

    def fields(self) -> dict[str, NDArray[Any]]:
        """The fields of the law's record as the translator takes them: constants, and places of
        coefficients among them."""
        out: dict[str, NDArray[Any]] = {}
        for name, places in self._places.items():
            flat = np.ravel(self.record[name]).astype(object)
            for k, place in enumerate(places):
                if place is not None:
                    at = Expr("var", ("t->c", number(place[0])))
                    flat[k] = Expr("neg", (at,)) if place[1] else at
            shape = np.shape(self.record[name])
            out[name] = flat.reshape(shape) if shape else flat[0]
        return out

    def keys(self, prefix: str) -> dict[str, str]:
        """What the templates of a module ask for."""
        real, double = self.first.dtype, np.dtype(np.float64)
        texts = {id(step): f"t{k}" for k, step in enumerate(self._steps)}
        texts |= {id(node): f"gains->{name}" for name, node in self._nodes.items()}

        def text(one: Any) -> str:
            return texts[id(one)] if isinstance(one, TracedNumber) else literal(one, double)

        members, ranges, lines = [], [], []
        for k, (name, (low, high)) in enumerate(self.ranges.items()):
            spec = self.file.parameters[name]
            allowed = f"{spec.unit}{', ' * bool(spec.free and spec.unit)}"
            allowed += f"{low:g} to {high:g}" * bool(spec.free)
            members.append(f"    double {name};" + f" /* {plain(allowed)} */" * bool(allowed))
            inside = f"{low!r} <= gains->{name} && gains->{name} <= {high!r}"
            if not spec.free:
                inside = f"fabs(gains->{name}) <= DBL_MAX"
            ranges.append(f"    if (!({inside})) {{\n        return {k + 1};\n    }}")
        for step in self._steps:
            a, b = text(step.args[0]), text(step.args[-1])
            does = {"neg": f"-{a}", "sqrt": f"sqrt({a})", "max": f"{a} < {b} ? {b} : {a}"}
            value = does.get(step.op, f"{a} {step.op} {b}")
            lines.append(f"    const double {texts[id(step)]} = {value};")
        holds = [f"{text(a)} <= {text(b)}" for a, b in self._book.holds]
        own = [f"    c[{k}] = ({prefix}_real)({text(one)});" for k, one in enumerate(self._made)]
        return {
            "GAIN_MEMBERS": "\n".join(members),
            "N_GAINS": str(len(self.gains)),
            "N_COEFFICIENTS": str(len(self.first)),
            "GAINS": _wrap(self.initialiser(self.gains)),
            "FIRST": _wrap(literals(self.first, real)),
            "GAIN_RANGES": "\n".join(ranges),
            "GAIN_STEPS": "\n".join(lines),
            "GAINS_HOLD": "\n        && ".join(holds) or "1",
            "COEFFICIENTS": "\n".join(own),
        }

    def initialiser(self, gains: Mapping[str, float]) -> str:
        """A structure of gains in C."""
        return "{" + literals([gains[name] for name in self.gains], np.dtype(np.float64)) + "}"

    def _fields(self, values: Mapping[str, Any]) -> dict[str, list[Any]]:
        """The fields of the law's record, flat."""
        file, book, law = self.file, self._book, self.record
        cells: dict[tuple[str, int, int], Element] = {}
        for matrix, of in (("phi", file.phi), ("psi", file.psi)):
            for key, specs in of.items():
                cell = int(key[0]) - 1, int(key[1]) - 1
                cells[matrix, *cell], _ = element_of(cell_name(matrix, cell), specs, values)
        rows, n = [], int(law["n"])
        for i in range(NU):
            phi, psi = ([cells.get((m, i, j), ZERO) for j in range(NY)] for m in ("phi", "psi"))
            T = self._scale((*phi, *psi), int(np.count_nonzero(law["row"][:n] == i)))
            rows.append(_row(book, i, phi, psi, T, self.T_s, file.limits.T_t))
        out: dict[str, NDArray[Any]] = {}
        for name in FIELDS:
            out[name] = np.full(law.dtype[name].shape, 0.0, object)
        impedance = file.error_map.R, file.error_map.X
        for k, value in enumerate(impedance):
            if value is not None:
                of = evaluate(f"error_map.{'RX'[k]}", value, values)
                book.compare(0.0 if k == 0 else math.ulp(0.0), of)
                out["error_parameters"][k] = of
        at = 0
        for i, row in enumerate(rows):
            m = len(row.c)
            for k in range(m):
                out["A"][at + k, at : at + m], out["C"][i, at + k] = row.A[k], row.c[k]
                for name in ("B_r", "B_y", "E_r", "E_y"):
                    out[name][at + k] = getattr(row, name)[k]
                out["F"][at + k, i], out["G"][at + k, i] = row.f[k], row.g[k]
                out["W"][at + k, i] = row.W[k]
            out["D_r"][i], out["D_y"][i] = row.d_r, row.d_y
            at += m
        self._close(out, rows[OMEGA_ROW], [k for k in range(n) if law["row"][k] == OMEGA_ROW])
        return {name: list(np.ravel(part)) for name, part in out.items()}

    def _scale(self, parts: Sequence[Element], n: int) -> list[float]:
        """Powers of two with which the states of a row are scaled, as at the file's values."""
        where = f"law {self.file.name!r}"
        d: Polynomial = (1.0,)
        for factor in union([e.den for e in parts]):
            d = poly_mul(d, [c / factor[-1] for c in factor])
        if len(d) - 1 != n:
            why = f"has {len(d) - 1} states in a row for most gains, {n} for those of its file"
            raise LawError(where, why)
        if n == 0:
            return []
        value = self._values({}, self._book.known.values())
        monic = np.array([value(c) for c in d])
        return [float(t) for t in np.exp2(np.round(np.log2(powers(monic))))]

    def _close(self, out: Mapping[str, Any], row: _Row, states: Sequence[int]) -> None:
        """The loop of omega_u over its own column, and that it is stable."""
        through = row.d_y[OMEGA_COLUMN]
        rest = 1.0 - through
        out["loop"][()] = 1.0 / rest
        for k in states:
            out["W"][k, OMEGA_ROW] = out["W"][k, OMEGA_ROW] * rest
        feeds = [b[OMEGA_COLUMN] for b in row.B_y]
        if all(map(_zero, [through, *feeds])):
            return
        book, where = self._book, f"law {self.file.name!r}"
        book.compare(through, _LOOP)
        a = [
            [x + b / rest * c for x, c in zip(line, row.c, strict=True)]
            for line, b in zip(row.A, feeds, strict=True)
        ]
        if len(a) > 2:
            raise LawError(where, "feeds omega_u back in a row of more than two states")
        trace = functools.reduce(operator.add, [a[k][k] for k in range(len(a))], 0.0)
        if len(a) == 1:
            bounds = [trace, -1.0 * trace]
        elif a:  # the conditions of Jury
            det = a[0][0] * a[1][1] - a[0][1] * a[1][0]
            bounds = [det, -1.0 * det, trace - det, -1.0 * trace - det]
        else:
            bounds = []
        for one in bounds:
            if isinstance(one, TracedNumber):
                book.compare(one, _ON_CIRCLE)


def _flat(table: Mapping[str, Any]) -> Iterator[Any]:
    for value in table.values():
        yield from _flat(value) if isinstance(value, dict) else [value]


def _wrap(numbers: str) -> str:
    return "\n    ".join(["", *textwrap.wrap(numbers, 96)])
