"""Arithmetic over named parameters in a law file, e.g. ``"2 * H * D_p"``."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

from gfm_runtime.errors import LawError, allowed

_BINARY: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_UNARY: dict[type[ast.unaryop], Callable[[float], float]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}


def evaluate(where: str, value: float | str, parameters: Mapping[str, float]) -> float:
    """A number, or an expression of + - * / ** ( ) over ``parameters``.

    Raises:
        LawError: naming ``where``: syntax, an unknown name, a result that is no finite number.
    """
    try:
        result = _walk(where, _parse(where, value), parameters)
    except RecursionError:
        raise LawError(where, "the expression is nested too deeply") from None
    except ArithmeticError as problem:
        raise LawError(where, f"{value!r}: {problem}") from None
    if isinstance(result, complex) or not math.isfinite(result):
        raise LawError(where, f"{value!r} gives {result}, not a finite number")
    return result


def evaluate_each(where: str, value: float | str, parameters: Mapping[str, Any]) -> Any:
    """As ``evaluate`` for parameters that are arrays; the result may hold values not finite."""
    return _walk(where, _parse(where, value), parameters)


def _parse(where: str, value: float | str) -> ast.expr:
    if not isinstance(value, str):
        return ast.Constant(value)
    try:
        return ast.parse(value.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError):  # ValueError: a null byte; Memory: nesting
        raise LawError(where, f"{value!r} is no arithmetic expression") from None


def _walk(where: str, node: ast.expr, parameters: Mapping[str, float]) -> float:
    match node:
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return float(number)
        case ast.Name(id=name):
            if name not in parameters:
                known = allowed(name, sorted(parameters), "known:")
                raise LawError(where, f"unknown parameter {name!r}; {known}")
            return parameters[name]
        case ast.UnaryOp(op=op, operand=operand) if type(op) in _UNARY:
            return _UNARY[type(op)](_walk(where, operand, parameters))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _BINARY:
            a, b = _walk(where, left, parameters), _walk(where, right, parameters)
            return _BINARY[type(op)](a, b)
    raise LawError(where, f"{ast.unparse(node)!r}: only + - * / ** ( ), numbers and names")
