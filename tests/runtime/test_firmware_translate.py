"""Python functions as C: what becomes of them, and what is refused."""

import math
from typing import Any

import numpy as np
import pytest

from gfm_runtime.firmware.translate import (
    Algebra,
    Array,
    Expr,
    Printer,
    Struct,
    Translator,
    Untranslatable,
    constants,
    number,
    operations,
    with_callees,
)

X = Expr("var", ("s->x",))
STATE = Struct({"x": X, "z": Array("s->z", (3,)), "on": Expr("var", ("s->on",), "int")})
C = Struct({"a": 2.0, "zero": 0.0, "one": 1.0, "row": np.array([0.5, 0.0, -1.0]), "n": 3})


def weighted(c: Any, s: Any) -> Any:
    """The sum of row z."""
    total = c.a * s.x
    for j in range(c.n):
        total += c.row[j] * s.z[j]
    return total


def stored(c: Any, s: Any) -> None:
    s.x = weighted(c, s)  # a comment


def scaled(value: Any, by: Any) -> Any:
    return value * by if value > 0 else value


def branches(c: Any, s: Any) -> None:
    y = s.x
    if s.on != 0:
        y = scaled(y, c.a)
    elif c.zero > 0:
        y = c.a
    s.x = math.sqrt(y + 0)


def text(python: Any, unroll: bool = True, algebra: Algebra | None = None, c: Any = C) -> str:
    entry = Translator(unroll, algebra).function(python, [c, STATE])
    printer = Printer(np.dtype("f4"), {"c": "c_t", "s": "s_t"})
    return "\n".join(map(printer.function, with_callees([entry])))


def test_a_loop_with_known_bounds_becomes_one_sum_without_zeros():
    assert text(stored) == (
        "static void stored(s_t *s)\n{\n    /* a comment */\n"
        "    s->x = 0x1p+1f /* a */ * s->x + 0x1p-1f * s->z[0] - s->z[2];\n}\n"
    )
    entry = Translator(True).function(stored, [C, STATE])
    assert operations(entry) == {"*": 2, "+": 1, "-": 1} and constants(entry) == {2.0, 0.5}
    kept = Translator(True, Algebra(all_terms=True)).function(stored, [C, STATE])
    assert operations(kept) == {"*": 4, "+": 2, "-": 1}


def test_without_known_constants_the_loop_and_the_function_stay():
    at_run_time = Struct(
        {"a": Expr("var", ("c->a",)), "n": Expr("var", ("c->n",), "int"),
         "row": Array("c->row", (3,))}
    )  # fmt: skip
    assert text(stored, unroll=False, c=at_run_time) == (
        "/* The sum of row z. */\n"
        "static real weighted(const c_t *c, const s_t *s)\n{\n    real total = c->a * s->x;\n"
        "    for (int j = 0; j < c->n; j++) {\n        total += c->row[j] * s->z[j];\n    }\n"
        "    return total;\n}\n\n"
        "static void stored(const c_t *c, s_t *s)\n{\n    /* a comment */\n"
        "    s->x = weighted(c, s);\n}\n"
    )


def test_a_branch_that_is_known_goes_and_a_function_of_numbers_stays():
    assert text(branches) == (
        "static real scaled(real value, real by)\n{\n"
        "    return value > 0.0f ? value * by : value;\n}\n\n"
        "static void branches(s_t *s)\n{\n    real y = s->x;\n    if (s->on != 0) {\n"
        "        y = scaled(y, 0x1p+1f /* a */);\n    }\n    s->x = sqrtf(y + 0.0f);\n}\n"
    )


def early(c: Any, s: Any) -> Any:
    if s.on != 0:
        return s.x, s.x
    return c.a, c.a


def of_early(c: Any, s: Any) -> None:
    s.z[0], s.z[1] = early(c, s)


def swapped(c: Any, s: Any) -> None:
    s.z[0], s.z[1] = s.z[1], s.z[0]


def unknown_field(c: Any, s: Any) -> None:
    s.x = c.b


def a_list(c: Any, s: Any) -> None:
    s.x = [c.a][0]


def nameless(c: Any, s: Any) -> None:
    s.x = max(s.x * c.a, s.x)


def unknown_index(c: Any, s: Any) -> None:
    s.x = c.row[s.on]


def old_value(c: Any, s: Any) -> None:
    y = s.x
    z = y
    y = s.z[0]
    s.z[1] = y
    s.z[2] = z + y


@pytest.mark.parametrize(
    ("python", "why"),
    [
        (of_early, "returns early, and must become part of its caller"),
        (swapped, "a later value reads what an earlier one changed"),
        (unknown_field, r"unknown_field, line 2: is no field: c\.b"),
        (a_list, "is not of the subset"),
        (nameless, "needs names for what it compares"),
        (unknown_index, "has no known index"),
    ],
)
def test_what_is_not_of_the_subset_is_refused(python, why):
    with pytest.raises(Untranslatable, match=why):
        text(python)


def test_a_name_that_is_used_again_keeps_its_values_apart():
    assert text(old_value) == (
        "static void old_value(s_t *s)\n{\n    real y = s->x;\n    const real z = y;\n"
        "    y = s->z[0];\n    s->z[1] = y;\n    s->z[2] = z + y;\n}\n"
    )


@pytest.mark.parametrize(
    ("sign", "a", "b", "gives"),
    [
        ("+", X, Expr("neg", (X,)), Expr("-", (X, X))),
        ("-", X, number(0.0), X), ("*", number(1.0), X, X), ("/", X, number(1.0), X),
        ("*", number(-1.0), X, Expr("neg", (X,))),
        ("-", X, Expr("*", (number(-2.0), X)), Expr("+", (X, Expr("*", (number(2.0), X))))),
        ("+", number(2), number(3), number(5)), ("<", number(2.0), number(3.0), number(True)),
        ("+", number(0.0), X, Expr("+", (number(0.0), X))),  # 0 + -0 is 0
        ("-", X, number(-0.0), Expr("-", (X, number(-0.0)))),  # -0 - -0 is 0
    ],
)  # fmt: skip
def test_only_what_changes_no_bit_goes(sign, a, b, gives):
    found = Algebra().binary(sign, a, b)
    assert repr(found) == repr(gives)
