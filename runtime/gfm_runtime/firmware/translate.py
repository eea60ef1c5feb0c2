"""Compiled functions of the kernel, from their Python source to C99.

The functions are of a small subset of Python: records of numbers and arrays of them, loops, calls
of one another and of sqrt, abs, min and max. Records and arrays are given by place: a field is a C
expression such as ``s->x``, or a constant. What is known is decided when the code is written: loops
over known numbers are unrolled, branches are chosen, and local names that a loop adds to become one
sum. Sums keep Python's order, so the bits are those of the compiled functions.

Whole numbers of fixed point are ``word`` (int32_t) or ``wide`` (int64_t): sums and products are
wide, and a place that is a word gets their lower bits.

A product with the constant 0 goes. It is +0 or -0 and changes no sum except one that is -0 itself;
the kernel makes the sums whose sign of zero could show +0 where they are -0. Factors and divisors
of 1 go too.
"""

from __future__ import annotations

import ast
import inspect
import io
import operator
import textwrap
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from gfm_runtime.firmware.c_text import literal, plain, wrap_line

_DOES = {"//": operator.floordiv, "<<": operator.lshift, ">>": operator.rshift,
         "&": operator.and_, "+": operator.add, "-": operator.sub, "*": operator.mul,
         "<": operator.lt,
         "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq,
         "!=": operator.ne}  # fmt: skip
_SIGNS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Lt: "<", ast.LtE: "<=",
          ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.FloorDiv: "//",
          ast.LShift: "<<", ast.RShift: ">>", ast.BitAnd: "&"}  # fmt: skip
_BINDS = {"?:": 1, "or": 2, "and": 3, "&": 4, "==": 5, "!=": 5, "<": 6, "<=": 6, ">": 6, ">=": 6,
          ">>": 7, "+": 8, "-": 8, "*": 9, "/": 9, "neg": 10, "not": 10}  # fmt: skip
_COMPARES = ("<", "<=", ">", ">=", "==", "!=")
_MATHS = {"sqrt": "sqrt", "fabs": "fabs", "abs": "fabs"}
_WORD = 2**31 - 1  # the largest int32_t
_FEW = 2  # rounds of a loop that are written out even where loops stay


class Untranslatable(ValueError):
    """A function is not of the subset; says which line, and why."""


@dataclass(frozen=True)
class Expr:
    """An expression: ``num`` (value), ``var`` (place, indices), ``local`` (definition), ``zero``
    (the product with 0 that it stands for), ``call`` (function, arguments), or an operator."""

    op: str
    args: tuple[Any, ...]
    kind: str = "real"
    label: str = field(default="", compare=False)  # of a constant: the field that it was

    @property
    def number(self) -> Any:
        """The value of a constant; None if it is none."""
        return self.args[0] if self.op == "num" else 0.0 if self.op == "zero" else None


@dataclass(frozen=True)
class Array:
    """A place with dimensions, or what some indices leave of it."""

    place: str
    shape: tuple[int, ...]
    kind: str = "real"
    index: tuple[Expr, ...] = ()


@dataclass(frozen=True)
class Struct:
    """A record among the arguments: its fields as constants, ``Expr`` or ``Array``."""

    fields: Mapping[str, Any]


@dataclass(eq=False)
class Variable:
    """A local variable gets a value. ``sums`` is for one that may become part of where it is used,
    and ``stays`` for one that a branch or a loop changes, or a parameter."""

    name: str
    value: Expr
    sums: bool = False
    stays: bool = False


@dataclass(eq=False)
class Assignment:
    """A place gets a value."""

    to: Expr
    value: Expr


@dataclass(eq=False)
class CallOrReturn:
    """A call, or a return with a value or without."""

    value: Expr | None
    returns: bool = False


@dataclass(eq=False)
class Compound:
    """``if``, ``while`` and ``for``; a loop ``for`` counts ``of`` from ``first`` to below
    ``value``."""

    word: str
    value: Expr
    body: list[Any]
    other: list[Any] = field(default_factory=list)
    of: Variable | None = None
    first: Expr | None = None


@dataclass(eq=False)
class Comment:
    """A comment."""

    text: str


@dataclass(eq=False)
class CFunction:
    """A function in C."""

    name: str  #: of Python's, without an underscore in front
    about: str  #: the first paragraph of its docstring
    parameters: list[Variable | Array]  #: the declared variables and arrays, in Python's order
    body: list[Any] = field(default_factory=list)  #: statements
    #: of what it returns: void, real, int or bool; or tuple, which only inlining returns
    kind: str = "void"

    def statements(self) -> Iterator[Any]:
        """All statements, inner ones too."""
        yield from _walk(self.body)

    def expressions(self) -> Iterator[Expr]:
        """All expressions, inner ones too, but not the targets of assignments."""
        for s in self.statements():
            for e in _own(s):
                yield from _parts(e)

    def places(self) -> Iterator[Expr]:
        """All places that it reads or writes itself."""
        yield from (e for e in self.expressions() if e.op == "var")
        yield from (s.to for s in self.statements() if isinstance(s, Assignment))

    def calls(self) -> Iterator[CFunction]:
        """The functions that it calls, each time."""
        for e in self.expressions():
            if e.op == "call" and isinstance(e.args[0], CFunction):
                yield e.args[0]

    def uses_and_writes(self) -> tuple[set[str], set[str]]:
        """The roots of the places that it uses, callees included, and of those it writes to."""
        uses, writes = set(), set()
        for s in self.statements():
            if isinstance(s, Assignment):
                writes.add(_root(s.to.args[0]))
        for e in self.expressions():
            if e.op == "var":
                uses.add(_root(e.args[0]))
            if e.op == "call" and isinstance(e.args[0], CFunction):
                used, written = e.args[0].uses_and_writes()
                names = {
                    p.place: _root(a.place)
                    for p, a in zip(e.args[0].parameters, e.args[1:], strict=True)
                    if isinstance(p, Array)
                }
                uses |= {names.get(root, root) for root in used}
                writes |= {names.get(root, root) for root in written}
        return uses | writes, writes


def _root(place: str) -> str:
    return place.split("->")[0]


def _walk(statements: Iterable[Any]) -> Iterator[Any]:
    for s in statements:
        yield s
        if isinstance(s, Compound):
            yield from _walk([*s.body, *s.other])


def _own(s: Any) -> list[Expr]:
    """The expressions of a statement itself; of a target its indices."""
    if isinstance(s, Assignment):
        return [*s.to.args[1:], s.value]
    if isinstance(s, Compound) and s.first is not None:
        return [s.first, s.value]
    return (
        [s.value]
        if isinstance(s, Variable | CallOrReturn | Compound) and s.value is not None
        else []
    )


def _parts(e: Any) -> Iterator[Expr]:
    if isinstance(e, Array):
        yield Expr("var", (e.place,), e.kind)
    if isinstance(e, Expr):
        yield e
        for part in e.args[e.op in ("var", "call", "num", "local") :]:
            yield from _parts(part)


def _local(of: Variable) -> Expr:
    return Expr("local", (of,), of.value.kind)


def number(value: Any) -> Expr:
    """A constant."""
    if isinstance(value, bool | np.bool_):
        return Expr("num", (bool(value),), "bool")
    if isinstance(value, int | np.integer):
        return Expr("num", (int(value),), "int" if abs(int(value)) <= _WORD else "wide")
    return Expr("num", (float(value),))


def _real(e: Expr) -> Expr:
    return replace(e, args=(float(e.args[0]),), kind="real") if e.op == "num" else e


def wide(e: Expr) -> Expr:
    """A whole number as one of 64 bits."""
    if e.op == "num" or e.kind == "wide":
        return replace(e, kind="wide")
    return Expr("cast", (e,), "wide")


def _is(e: Expr, value: float) -> bool:
    return e.op == "num" and e.args[0] == value


@dataclass
class Algebra:
    """How expressions are joined. With ``all_terms`` no product goes: where constants are not
    known, or a sum begins with the constant -0."""

    all_terms: bool = False

    def binary(self, sign: str, a: Expr, b: Expr) -> Expr:
        """Of + - * / and comparisons."""
        if "real" in (a.kind, b.kind):
            a, b = _real(a), _real(b)
        elif {"word", "wide"} & {a.kind, b.kind} and (a.number is None or b.number is None):
            return self._whole(sign, a, b)
        kind = "bool" if sign in _COMPARES else "real" if "real" in (a.kind, b.kind) else "int"
        if kind != "real" and a.number is not None and b.number is not None:
            return number(_DOES[sign](a.number, b.number))
        if sign == "-" and a.op == "num" and a == b:
            return number(0.0)
        if kind == "real" and not self.all_terms:
            short = (self._sum if sign in "+-" else self._product)(sign, a, b)
            if short is not None:
                return short
        return Expr(sign, (_as_number(a), _as_number(b)), kind)

    def _whole(self, sign: str, a: Expr, b: Expr) -> Expr:
        """Of whole numbers, one of which is no constant."""
        if sign == "+" and a.number == 0:
            return b
        compares = sign in _COMPARES
        if "wide" in (a.kind, b.kind) or not (compares or sign in ("*", ">>")):
            a, b = (wide(e) if e.op == "num" and sign != ">>" else e for e in (a, b))
        return Expr(sign, (a, b), "bool" if compares else "wide")

    def _sum(self, sign: str, a: Expr, b: Expr) -> Expr | None:
        if b.op == "zero":
            return a
        if a.op == "zero":
            return b if sign == "+" else self.negative(b)
        if sign == "-" and _is(b, 0.0) and not np.signbit(b.args[0]):
            return a
        other = "-" if sign == "+" else "+"
        if b.op == "neg":
            return Expr(other, (a, b.args[0]))
        if b.op == "*" and b.args[0].op == "num" and b.args[0].args[0] < 0:
            return Expr(other, (a, Expr("*", (self.negative(b.args[0]), b.args[1]))))
        return None

    def _product(self, sign: str, a: Expr, b: Expr) -> Expr | None:
        if _is(b, 1.0):
            return a
        if a.op == "zero" or (sign == "*" and (b.op == "zero" or _is(a, 0.0) or _is(b, 0.0))):
            return Expr("zero", (Expr(sign, (_as_number(a), _as_number(b))),))
        if sign == "*" and (_is(a, 1.0) or _is(a, -1.0)):
            return b if a.args[0] > 0 else self.negative(b)
        return None

    def negative(self, e: Expr) -> Expr:
        """-e."""
        if e.op == "num":
            return replace(e, args=(-e.args[0],))
        return e if e.op == "zero" else (e.args[0] if e.op == "neg" else Expr("neg", (e,), e.kind))

    def join(self, word: str, parts: Sequence[Expr]) -> Expr:
        """Of ``and`` and ``or``; what is known goes."""
        decides = word == "or"
        if any(p.op == "num" and bool(p.args[0]) == decides for p in parts):
            return number(decides)
        left = tuple(p for p in parts if p.op != "num")
        if len(left) < 2:
            return left[0] if left else number(not decides)
        return Expr(word, left, "bool")


def _as_number(e: Expr) -> Expr:
    return number(0.0) if e.op == "zero" else e


@cache
def _source(python: Any) -> tuple[ast.FunctionDef, dict[int, str], dict[str, Any]]:
    """A function's tree, its comments by the line of what they are about, and its globals."""
    python = getattr(python, "py_func", python)
    text = textwrap.dedent(inspect.getsource(python))
    (tree,) = ast.parse(text).body
    assert isinstance(tree, ast.FunctionDef)
    notes, lines = dict[int, str](), text.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row = token.start[0]
            alone = lines[row - 1].lstrip().startswith("#")
            notes[row + alone] = f"{notes.pop(row, '')} {token.string.lstrip('# ')}".strip()
    return tree, notes, python.__globals__


class Translator:
    """The functions of one C source.

    Args:
        unroll: whether loops with known bounds are written out, and small functions become part of
            their callers.
        algebra: how expressions are joined.
        primitives: functions that C has by itself, by name the kind of what they return.
    """

    def __init__(
        self,
        unroll: bool,
        algebra: Algebra | None = None,
        primitives: Mapping[str, str] | None = None,
    ) -> None:
        self.unroll, self.algebra = unroll, algebra or Algebra()
        self.primitives = primitives or {}
        self._made: dict[Any, CFunction] = {}

    def function(self, python: Any, values: Sequence[Any]) -> CFunction:
        """A function for arguments of these kinds: records, constants and arrays are part of it,
        and numbers are its parameters."""
        tree, _, _ = _source(python)
        names, passed = [a.arg for a in tree.args.args], list(map(id, self.arguments(values)))
        bound, parameters, env = [], list[Variable | Array](), dict[str, Any]()
        for key, value in zip(names, values, strict=True):
            if isinstance(value, Expr) and id(value) in passed:
                let = Variable(key, Expr("var", (key,), value.kind), stays=True)
                parameters.append(let)
                env[key] = _local(let)
            elif isinstance(value, Array):
                shape = value.shape[len(value.index) :]
                parameters.append(Array(key, shape, value.kind))
                env[key] = parameters[-1]
            else:
                env[key] = value
                bound.append(repr(value) if isinstance(value, Expr) else id(value))
        made = (python, *bound, *(p.kind if isinstance(p, Array) else "" for p in parameters))
        if made not in self._made:
            doc = (ast.get_docstring(tree) or "").split("\n\n")[0]
            name = tree.name.lstrip("_")
            again = sum(key[0] is python for key in self._made)
            one = CFunction(name + f"_{again + 1}" * (again > 0), plain(doc), parameters)
            body = _Body(self, python, env, one)
            body.block(tree.body, one.body)
            tidy(one)
            self._made[made] = one
        return self._made[made]

    def arguments(self, values: Sequence[Any]) -> list[Any]:
        """The arguments that stay arguments; constants become part of a function with a record."""
        scalar = not any(isinstance(v, Struct | Array) for v in values)
        return [
            v
            for v in values
            if isinstance(v, Array)
            or (isinstance(v, Expr) and (scalar or not self.unroll or v.op != "num"))
        ]

    def short(self, one: CFunction) -> bool:
        """Whether a function becomes part of its callers."""
        straight = one.kind != "void" and all(
            isinstance(s, Variable | Comment) or (isinstance(s, CallOrReturn) and s.returns)
            for s in one.body
        )
        records = any(e.op == "var" and "->" in e.args[0] for e in one.expressions())
        alone = not one.parameters
        return one.kind == "tuple" or (self.unroll and straight and (records or alone))


@dataclass
class _Body:
    """The statements of a function, with what its names stand for at this point."""

    of: Translator
    python: Any
    env: dict[str, Any]
    function: CFunction
    inlined: bool = False
    result: Any = None
    ended: bool = False  # by a return
    shared: set[str] = field(default_factory=set)  # names that a branch or a loop changes
    said: set[Any] = field(default_factory=set)  # the comments that are written
    taken: set[str] = field(default_factory=set)  # names of the functions that this is part of

    def fail(self, node: ast.AST, why: str) -> Untranslatable:
        line = getattr(node, "lineno", 0)
        return Untranslatable(f"{self.function.name}, line {line}: {why}: {ast.unparse(node)}")

    # --- statements ---

    def block(self, statements: Iterable[ast.stmt], out: list[Any]) -> None:
        notes = _source(self.python)[1]
        for node in statements:
            if self.ended:
                return
            start = len(out)
            self.statement(node, out)
            text = notes.get(node.lineno)
            if text and len(out) > start and (self.python, node.lineno) not in self.said:
                self.said.add((self.python, node.lineno))
                out.insert(start, Comment(plain(text)))

    def statement(self, node: ast.stmt, out: list[Any]) -> None:
        match node:
            case ast.Expr(ast.Constant()) | ast.Pass():
                pass
            case ast.Expr(ast.Call() as call):
                self.call(call, out, alone=True)
            case ast.Assign(targets, value):
                self.assign(node, targets, self.value(value, out), out)
            case ast.AugAssign(target, op, value):
                old = self.value(target, out)
                if old.op == "local":
                    old.args[0].sums = True
                new = self.of.algebra.binary(_SIGNS[type(op)], old, self.value(value, out))
                self.assign(node, [target], new, out)
                if isinstance(target, ast.Name) and self.env[target.id].op == "local":
                    self.env[target.id].args[0].sums = True
            case ast.If(test, body, other):
                self.branch(self.value(test, out), body, other, out)
            case ast.For(ast.Name() as name, iterable, body):
                self.loop(name.id, iterable, body, out)
            case ast.For(ast.Tuple(targets), iterable, body):
                for values in self.value(iterable, out):
                    for name_of, one in zip(targets, values, strict=True):
                        self.put(self.target(name_of, out), _constant(one), out)
                    self.block(body, out)
            case ast.While(test, body):
                self.share(body, out)
                block = Compound("while", self.value(test, out), [])
                self.inner(body, block.body)
                out.append(block)
            case ast.Return(value):
                self.finish(node, None if value is None else self.value(value, out), out)
            case _:
                raise self.fail(node, "is not of the subset")

    def finish(self, node: ast.AST, value: Any, out: list[Any]) -> None:
        self.ended = True
        if self.inlined:
            self.result = value
        elif isinstance(value, tuple):
            self.function.kind = "tuple"
        else:
            out.append(CallOrReturn(value and _as_number(value), returns=True))
            if value is not None and self.function.kind != "real":
                self.function.kind = value.kind

    def assign(self, node: ast.stmt, targets: list[Any], value: Any, out: list[Any]) -> None:
        if isinstance(targets[0], ast.Tuple):
            places = [self.target(t, out) for t in targets[0].elts]
            for k, place in enumerate(places):
                if any(place in _parts(v) for v in value[k + 1 :] if isinstance(place, Expr)):
                    raise self.fail(node, "a later value reads what an earlier one changed")
            for place, one in zip(places, value, strict=True):
                self.put(place, one, out)
            return
        for target in targets:
            place = self.target(target, out)
            self.put(place, value, out)
            if isinstance(place, Expr) and value.op != "num":
                value = place

    def target(self, node: ast.expr, out: list[Any]) -> Any:
        return node.id if isinstance(node, ast.Name) else self.value(node, out)

    def put(self, place: Any, value: Any, out: list[Any]) -> None:
        if isinstance(place, Expr):
            value = _real(_as_number(value)) if place.kind == "real" else value
            value = wide(value) if place.kind == "wide" else value
            if value != place:
                out.append(Assignment(place, value))
            return
        known = not isinstance(value, Expr) or value.op in ("num", "zero")
        if place in self.shared or not known:
            tree = _source(self.python)[0]
            name = f"{tree.name.lstrip('_')}_{place}" if place in self.taken else place
            let = Variable(name, _as_number(value), sums=self.inlined, stays=place in self.shared)
            out.append(let)
            value = _local(let)
        self.env[place] = value

    def share(self, body: Iterable[ast.stmt], out: list[Any]) -> None:
        """Make variables of the names that these statements change."""
        names = {
            n.id
            for s in body
            for n in ast.walk(s)
            if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store) and n.id in self.env
        }
        for name in names - self.shared:
            value = self.env[name]
            if isinstance(value, Expr):
                self.shared.add(name)
                if value.op == "local" and value.args[0].name.endswith(name):
                    value.args[0].stays = True
                else:
                    self.put(name, value, out)

    def inner(self, body: Sequence[ast.stmt], out: list[Any]) -> None:
        """A body that may not run: after it, a shared name is its variable."""
        before = dict(self.env)
        self.block(body, out)
        if self.ended and (self.inlined or self.function.kind == "tuple"):
            raise self.fail(body[-1], "returns early, and must become part of its caller")
        self.env, self.ended = before, False

    def branch(
        self, test: Expr, body: list[ast.stmt], other: list[ast.stmt], out: list[Any]
    ) -> None:
        if test.op == "num":
            self.block(body if test.args[0] else other, out)
            return
        shared = set(self.shared)
        self.share([*body, *other], out)
        block = Compound("if", test, [])
        self.inner(body, block.body)
        self.inner(other, block.other)
        self.shared = shared
        out.append(block)

    def loop(self, name: str, iterable: ast.expr, body: list[ast.stmt], out: list[Any]) -> None:
        if isinstance(iterable, ast.Tuple | ast.Name):
            rounds: Iterable[Any] | None = self.value(iterable, out)
        elif isinstance(iterable, ast.Call):
            ends = [self.value(a, out) for a in iterable.args]
            first, last = ends if len(ends) == 2 else (number(0), ends[0])
            known = first.op == last.op == "num"
            rounds = None
            if known and (self.of.unroll or last.args[0] - first.args[0] <= _FEW):
                rounds = map(number, range(first.args[0], last.args[0]))
        if rounds is not None:
            for one in rounds:
                self.env[name] = one
                self.block(body, out)
            self.env.pop(name, None)
            return
        shared = set(self.shared)
        self.share(body, out)
        counter = Variable(name, Expr("var", (name,), "int"), stays=True)
        block = Compound("for", last, [], of=counter, first=first)
        self.env[name] = _local(counter)
        self.inner(body, block.body)
        self.shared = shared
        out.append(block)

    # --- expressions ---

    def value(self, node: ast.expr, out: list[Any]) -> Any:
        algebra = self.of.algebra
        match node:
            case ast.Constant(value):
                return number(value)
            case ast.Name(name):
                value = self.env.get(name, _source(self.python)[2].get(name))
                known = isinstance(value, int | float)
                return replace(number(value), label=name.strip("_")) if known else value
            case ast.Attribute(ast.Name("math"), name):
                return name
            case ast.Attribute(of, name):
                record = self.value(of, out)
                if not isinstance(record, Struct | Expr | Array):
                    return _constant(getattr(record, name))
                if not isinstance(record, Struct) or name not in record.fields:
                    raise self.fail(node, "is no field")
                value = record.fields[name]
                simple = isinstance(value, Expr | Array) or np.ndim(value)
                return value if simple else replace(number(value), label=name)
            case ast.Subscript(of, at):
                several = at.elts if isinstance(at, ast.Tuple) else [at]
                return self.element(
                    node, self.value(of, out), [self.value(i, out) for i in several]
                )
            case ast.BinOp(left, op, right):
                a, b = self.value(left, out), self.value(right, out)
                return algebra.binary(_SIGNS[type(op)], a, b)
            case ast.UnaryOp(ast.USub(), of):
                return algebra.negative(self.value(of, out))
            case ast.UnaryOp(ast.Not(), of):
                value = self.value(of, out)
                if value.op == "num":
                    return number(not value.args[0])
                return Expr("not", (value,), "bool")
            case ast.Compare(left, [op], [right]):
                a, b = self.value(left, out), self.value(right, out)
                return algebra.binary(_SIGNS[type(op)], a, b)
            case ast.BoolOp(op, values):
                word = "and" if isinstance(op, ast.And) else "or"
                return algebra.join(word, [self.value(v, out) for v in values])
            case ast.IfExp(test, then, other):
                return self.choice(self.value(test, out), self.value(then, out),
                                   self.value(other, out))  # fmt: skip
            case ast.Tuple(elements):
                return tuple(self.value(e, out) for e in elements)
            case ast.Call():
                return self.call(node, out)
        raise self.fail(node, "is not of the subset")

    def choice(self, test: Expr, a: Expr, b: Expr) -> Expr:
        if test.op == "num":
            return a if test.args[0] else b
        kind = next((k for k in ("real", "wide") if k in (a.kind, b.kind)), a.kind)
        a, b = (_real(_as_number(e)) if kind == "real" else e for e in (a, b))
        return Expr("?:", (test, a, b), kind)

    def element(self, node: ast.AST, of: Any, at: list[Expr]) -> Any:
        if isinstance(of, Array):
            index = (*of.index, *at)
            if len(index) < len(of.shape):
                return replace(of, index=index)
            return Expr("var", (of.place, *index), of.kind)
        if any(i.op != "num" for i in at):
            raise self.fail(node, "has no known index")
        if isinstance(of, tuple | list):
            return _constant(of[at[0].args[0]])
        value = of[tuple(i.args[0] for i in at)]
        return value if np.ndim(value) or isinstance(value, Expr) else number(value)

    def call(self, node: ast.Call, out: list[Any], alone: bool = False) -> Any:
        values = [self.value(a, out) for a in node.args]
        match node.func:
            case ast.Attribute(_, "type"):  # a.dtype.type(value): in the precision of a
                return _real(values[0])
            case ast.Name("len"):
                of = values[0]
                return number(of.shape[0] if isinstance(of, Array) else len(of))
            case ast.Name("min" | "max" as name):
                a, b = values
                if any(e.op not in ("num", "local", "var") for e in values):
                    raise self.fail(node, "needs names for what it compares")
                test = self.of.algebra.binary("<" if name == "min" else ">", b, a)
                return self.choice(test, b, a)
            case ast.Name(name) | ast.Attribute(_, name) if name in _MATHS:
                return Expr("call", (_MATHS[name], *map(_as_number, values)))
            case ast.Name("wide"):
                return wide(values[0])
            case ast.Name("divided"):
                return Expr("/", tuple(values), "wide")
            case ast.Name(name) if name in self.of.primitives:
                return Expr("call", (name, *values), self.of.primitives[name])
        python = self.value(node.func, out)
        if hasattr(python, "__self__"):  # a method of a constant
            known = (v.args[0] if isinstance(v, Expr) else v for v in values)
            return _constant(python(*known))
        one = self.of.function(python, values)
        if self.of.short(one):
            return self.inline(python, values, out)
        passed = [_as_number(v) if isinstance(v, Expr) else v for v in self.of.arguments(values)]
        call = Expr("call", (one, *passed), one.kind)
        if alone and one.body:
            out.append(CallOrReturn(call))
        return call

    def inline(self, python: Any, values: list[Any], out: list[Any]) -> Any:
        """The statements of a function where it is called; what it returns."""
        tree, _, _ = _source(python)
        own = {n.id for n in ast.walk(_source(self.python)[0]) if isinstance(n, ast.Name)}
        taken = self.taken | own
        body = _Body(self.of, python, {}, self.function, inlined=True, said=self.said, taken=taken)
        for a, value in zip(tree.args.args, values, strict=True):
            if isinstance(value, Expr) and value.op == "local" and not value.args[0].stays:
                body.env[a.arg] = value
            else:
                body.put(a.arg, value, out)
        body.block(tree.body, out)
        return body.result


def _constant(value: Any) -> Any:
    """What is known, as an expression if it is a number."""
    return number(value) if isinstance(value, int | float | np.number) else value


# --- what goes, and what becomes one ---


def tidy(one: CFunction, unread: Sequence[Expr] = ()) -> None:
    """Take out variables that nothing uses and writes to the places ``unread``, and make sums of
    what was added step by step."""
    while _prune(one.body, _uses(one), unread):
        pass
    _join_sums(one.body, _uses(one))
    _check_names(one)


def _uses(one: CFunction) -> Counter[Variable]:
    return Counter(e.args[0] for e in one.expressions() if e.op == "local")


def _prune(body: list[Any], uses: Counter[Variable], unread: Sequence[Expr]) -> bool:
    kept: list[Any] = []
    for s in body:
        if isinstance(s, Compound) and (
            _prune(s.body, uses, unread) | _prune(s.other, uses, unread)
        ):
            return True
        idle = isinstance(s, Compound) and s.word != "while" and not s.body and not s.other
        idle = idle or (isinstance(s, Variable) and not s.stays and not uses[s])
        idle = idle or (isinstance(s, Assignment) and s.to in unread)
        last = kept[-1] if kept else None
        if idle:
            if isinstance(last, Comment):
                kept.pop()
        else:
            kept.append(s)
    changed = len(kept) < len(body)
    body[:] = kept
    return changed


def _join_sums(body: list[Any], uses: Counter[Variable]) -> None:
    for k, let in reversed(list(enumerate(body))):  # a sum's last part first
        if isinstance(let, Compound):
            _join_sums(let.body, uses)
            _join_sums(let.other, uses)
        if not (isinstance(let, Variable) and let.sums and not let.stays and uses[let] == 1):
            continue
        for s in body[k + 1 :]:
            if any(e == _local(let) for own in _own(s) for e in _parts(own)):
                if not (isinstance(s, Compound) and s.word != "if"):
                    _substitute(s, let)
                    del body[k]
                break
            if _disturbs(s, let.value):
                break


def _disturbs(s: Any, value: Expr) -> bool:
    """Whether a statement changes what an expression reads."""
    reads = [e for e in _parts(value) if e.op == "var"]
    names = {e.args[0].name for e in _parts(value) if e.op == "local"}
    for one in _walk([s]):
        if isinstance(one, Assignment) and any(_meet(one.to, e) for e in reads):
            return True
        if isinstance(one, Variable) and one.name in names:
            return True
        if isinstance(one, CallOrReturn) and one.value and one.value.op == "call" and reads:
            return True
    return False


def _meet(a: Expr, b: Expr) -> bool:
    """Whether two places may be one."""
    pairs = zip(a.args[1:], b.args[1:], strict=False)
    apart = any(i.op == j.op == "num" and i != j for i, j in pairs)
    return a.args[0] == b.args[0] and not apart


def _substitute(s: Any, let: Variable) -> None:
    def new(e: Any) -> Any:
        if not isinstance(e, Expr):
            return e
        if e == _local(let):
            return let.value
        at = e.op in ("var", "call")
        if e.op in ("num", "local"):
            return e
        args = (*e.args[:at], *map(new, e.args[at:]))
        if e.op in ("+", "-") and len(args) == 2 and args != e.args:
            return Algebra().binary(e.op, *args)
        return replace(e, args=args)

    s.value = new(s.value)
    if isinstance(s, Assignment):
        s.to = new(s.to)


def _check_names(one: CFunction) -> None:
    """A name that is used again must not be read at its old value."""
    now: dict[str, Variable] = {}

    def visit(body: Iterable[Any]) -> None:
        for s in body:
            for own in _own(s):
                for e in _parts(own):
                    let = e.args[0] if e.op == "local" else None
                    if let and not let.stays and now.get(let.name, let) is not let:
                        raise Untranslatable(f"{one.name}: {let.name} needs another name")
            if isinstance(s, Variable):
                now[s.name] = s
            if isinstance(s, Compound):
                visit(s.body)
                visit(s.other)

    visit(one.body)


def with_callees(entries: Iterable[CFunction]) -> list[CFunction]:
    """These functions and those that they call, callees first."""
    out: list[CFunction] = []

    def visit(one: CFunction) -> None:
        for other in one.calls():
            visit(other)
        if one not in out:
            out.append(one)

    for one in entries:
        visit(one)
    return out


def without_unread(functions: Sequence[CFunction], prefix: str) -> None:
    """Take out what is written to places that begin with ``prefix`` and that nothing reads."""
    while True:
        reads = [e for f in functions for e in f.expressions() if e.op == "var"]
        writes = [s.to for f in functions for s in f.statements() if isinstance(s, Assignment)]
        unread = [
            to
            for to in writes
            if to.args[0].startswith(prefix) and not any(_meet(to, e) for e in reads)
        ]
        if not unread:
            return
        for one in functions:
            tidy(one, unread)


# --- operations ---


def operations(entry: CFunction) -> Counter[str]:
    """How often each operator on numbers of the signals' kind stands in a call of ``entry``, all
    branches included; the comparisons together, and sqrt."""
    out: Counter[str] = Counter()
    for e in entry.expressions():
        if e.op == "call":
            what = e.args[0]
            out += operations(what) if isinstance(what, CFunction) else Counter([what])
        elif e.op in _COMPARES and e.args[0].kind in ("real", "word", "wide"):
            out["<"] += 1
        elif e.kind in ("real", "wide") and e.op in ("+", "-", "*", "/"):
            out[e.op] += 1
    return out


def constants(entry: CFunction) -> set[float]:
    """The different numbers in a call of ``entry`` but 0 and 1."""
    return {
        e.args[0]
        for one in with_callees([entry])
        for e in one.expressions()
        if e.op == "num" and e.kind == "real" and e.args[0] not in (0.0, 1.0)
    }


# --- text ---


class Printer:
    """How functions look in C.

    Args:
        real: the precision.
        roots: by the name of a pointer that functions get, in order, the type.
        indices: by place, names of its indices.
        real_type: what a real number is called.
    """

    def __init__(
        self,
        real: np.dtype[Any],
        roots: Mapping[str, str],
        indices: Mapping[str, Sequence[str]] | None = None,
        real_type: str = "real",
    ) -> None:
        self.real, self.roots = real, roots
        self._types = {"real": real_type, "word": "int32_t", "wide": "int64_t"}
        self._types |= {name: name for name in ("int", "bool", "void")}
        self.indices = indices or {}
        self.end = "f" if real == np.float32 else ""

    def function(self, one: CFunction) -> str:
        """A function with its comment."""
        uses, writes = one.uses_and_writes()
        self._often = Counter(s.name for s in one.statements() if isinstance(s, Variable))
        given = [
            f"{'' if root in writes else 'const '}{kind} *{root}"
            for root, kind in self.roots.items()
            if root in uses
        ]
        for p in one.parameters:
            if isinstance(p, Array):
                constant = "" if p.place in writes else "const "
                given.append(f"{constant}{self._types[p.kind]} {p.place}[]")
            else:
                given.append(f"{self._types[p.value.kind]} {p.name}")
        names = {p.place if isinstance(p, Array) else p.name for p in one.parameters}
        lines = [f"/* {one.about} */"] if one.about else []
        lines = ["\n * ".join(textwrap.wrap(line, 97)) for line in lines]
        lines += wrap_line(
            f"static {self._types[one.kind]} {one.name}({', '.join(given) or 'void'})"
        )
        used = uses | {e.args[0].name for e in one.expressions() if e.op == "local"}
        idle = [f"    (void){name};" for name in sorted(names - used)]
        return "\n".join([*lines, "{", *idle, *self._block(one.body, names, "    "), "}", ""])

    def _block(self, body: Sequence[Any], names: set[str], indent: str) -> list[str]:
        lines, names = list[str](), set(names)
        for s in body:
            match s:
                case Comment(text):
                    lines.append(f"{indent}/* {text} */")
                case Variable(name, value):
                    if name in names:
                        lines += wrap_line(indent + self._put(name, _local(s), value))
                    else:
                        once = self._often[name] == 1 and not s.stays
                        what = f"{'const ' * once}{self._types[value.kind]} {name}"
                        lines += wrap_line(f"{indent}{what} = {self.expression(value)};")
                        names.add(name)
                case Assignment(to, value):
                    lines += wrap_line(indent + self._put(self.expression(to), to, value))
                case CallOrReturn(value, returns):
                    text = self.expression(value) if value else ""
                    lines += wrap_line(f"{indent}{'return ' * returns}{text}".rstrip() + ";")
                case Compound():
                    lines += self._inner(s, names, indent)
        return lines

    def _inner(self, s: Compound, names: set[str], indent: str, word: str = "") -> list[str]:
        test = self.expression(s.value)
        if s.of is not None and s.first is not None:
            i = s.of.name
            head = f"for (int {i} = {self.expression(s.first)}; {i} < {test}; {i}++)"
            names = names | {i}
        else:
            head = f"{s.word} ({test})"
        lines = wrap_line(f"{indent}{word}{head} {{")
        lines += self._block(s.body, names, indent + "    ")
        more = [one for one in s.other if not isinstance(one, Comment)]
        if len(more) == 1 and isinstance(more[0], Compound) and more[0].word == "if":
            return lines + self._inner(more[0], names, indent, "} else ")
        if s.other:
            lines += [f"{indent}}} else {{", *self._block(s.other, names, indent + "    ")]
        elif word:
            lines += [f"{indent}}} else {{", f"{indent}    /* nothing */"]
        return [*lines, f"{indent}}}"]

    def _put(self, to: str, place: Expr, value: Expr) -> str:
        if place.kind == "word" and value.kind == "wide":
            return f"{to} = (int32_t){self.expression(value, _BINDS['neg'])};"
        same = value.op in ("+", "-", "*", "/") and (
            value.args[0] == place
            or (value.args[0].op == place.op == "local" and value.args[0].args[0].name == to)
        )
        if same:
            return f"{to} {value.op}= {self.expression(value.args[1])};"
        return f"{to} = {self.expression(value)};"

    def expression(self, e: Any, outer: int = 0, right: bool = False) -> str:
        """An expression, in parentheses if it binds less than what is around it."""
        if isinstance(e, Array):
            return e.place + "".join(f"[{self.expression(i)}]" for i in e.index)
        match e.op:
            case "num":
                return self.number(e)
            case "local":
                return str(e.args[0].name)
            case "var":
                place, *index = e.args
                return place + "".join(f"[{self._index(place, i)}]" for i in index)
            case "call":
                return self._call(e)
        if e.op == "cast":
            return f"(int64_t){self.expression(e.args[0], _BINDS['neg'])}"
        if e.kind == "wide" and not any(a.kind == "wide" for a in e.args) and e.op in "+-*":
            a, b = e.args
            if e.op == "*":
                return f"product({self.expression(a)}, {self.expression(b)})"
            e = replace(e, args=(wide(a), b))
        binds = _BINDS[e.op]
        if e.op in ("neg", "not"):
            text = ("-" if e.op == "neg" else "!") + self.expression(e.args[0], binds)
        elif e.op == "?:":
            test, a, b = (self.expression(part, binds + 1) for part in e.args)
            text = f"{test} ? {a} : {b}"
        elif e.op in ("and", "or"):
            sign = " && " if e.op == "and" else " || "
            text = sign.join(self.expression(part, _BINDS["and"] + 1) for part in e.args)
        else:
            a, b = e.args
            text = f"{self.expression(a, binds)} {e.op} {self.expression(b, binds, True)}"
        return f"({text})" if binds < outer or (right and binds == outer) else text

    def _call(self, e: Expr) -> str:
        what, *given = e.args
        arguments = [self.expression(a) for a in given]
        if isinstance(what, CFunction):
            return self.call(what, arguments)
        return f"{what}{self.end}({', '.join(arguments)})"

    def call(self, one: CFunction, arguments: Sequence[str], at: Mapping[str, str] = {}) -> str:
        """A call of a function; ``at`` says what stands for a pointer if not its name."""
        uses, _ = one.uses_and_writes()
        roots = [at.get(root, root) for root in self.roots if root in uses]
        return f"{one.name}({', '.join([*roots, *arguments])})"

    def _index(self, place: str, i: Expr) -> str:
        named = self.indices.get(place)
        return named[i.args[0]] if named and i.op == "num" else self.expression(i)

    def number(self, e: Expr) -> str:
        """A constant: 0 and 1 in decimals, other real numbers exact to the bit."""
        value = e.args[0]
        if e.kind == "real":
            small = value in (0.0, 1.0) and not np.signbit(value)
            text = f"{value:.1f}{self.end}" if small else literal(value, self.real)
        else:
            text = f"INT64_C({value})" if e.kind == "wide" else str(value).lower()
        return f"{text} /* {e.label} */" if e.label else text
