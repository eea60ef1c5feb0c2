"""Arithmetic over named parameters in a law file, e.g. ``"2 * H * D_p"``."""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from gfm_runtime.errors import LawError, allowed
from gfm_runtime.mistakes import lines
from gfm_runtime.toml_file import TomlTable

T = TypeVar("T", bound=TomlTable)

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


def evaluate(where: str, value: float | str, parameters: Mapping[str, Any]) -> Any:
    """A number, or an expression of + - * / ** ( ) over ``parameters``.

    Of parameters that are arrays the result is one, and may hold values that are not finite. Raises
    LawError: naming ``where``: syntax, an unknown name, a result that is no finite number.
    """
    try:
        result = _walk(where, _parse(where, value), parameters)
    except RecursionError:
        raise LawError(where, "the expression is nested too deeply") from None
    except ArithmeticError as problem:
        raise LawError(where, f"{value!r}: {problem}") from None
    if np.ndim(result) == 0 and (isinstance(result, complex) or not math.isfinite(result)):
        raise LawError(where, f"{value!r} gives {result}, not a finite number")
    return result


def evaluated(where: str, table: T, parameters: Mapping[str, float]) -> T:
    """The table with a number in place of each expression, checked again. Raises LawError: naming
    ``where`` and the key: as ``evaluate``, and a number that is not allowed."""
    values = {name: getattr(table, name) for name in table.model_fields_set}
    for name, value in values.items():
        if isinstance(value, TomlTable):
            values[name] = evaluated(f"{where}.{name}", value, parameters)
        elif type(table).model_fields[name].annotation == float | str:
            values[name] = evaluate(f"{where}.{name}", value, parameters)
    try:
        return type(table)(**values)
    except ValidationError as problem:
        texts = lines(problem, type(table))
        raise LawError(where, *texts, lines=[f"{where}.{text}" for text in texts]) from None


def _parse(where: str, value: float | str) -> ast.expr:
    if not isinstance(value, str):
        return ast.Constant(value)
    try:
        return ast.parse(value.strip(), mode="eval").body
    except (SyntaxError, ValueError, MemoryError):  # ValueError: a null byte; Memory: nesting
        raise LawError(where, f"{value!r} is no arithmetic expression") from None


def _walk(where: str, node: ast.expr, parameters: Mapping[str, Any]) -> Any:
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
