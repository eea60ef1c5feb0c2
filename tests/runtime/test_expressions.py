"""Arithmetic in law files."""

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_runtime.errors import LawError
from gfm_runtime.expressions import evaluate

from ..support.laws import repeatable

NUMBERS = {"H": 8.36, "D_p": 0.01, "k": -2.5}

texts = st.recursive(
    st.one_of(
        st.floats(0.001, 1000.0).map(repr),
        st.integers(0, 9).map(str),
        st.sampled_from(sorted(NUMBERS)),
    ),
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from(["+", "-", "*", "/", "**"]), inner).map(" ".join),
        inner.map(lambda t: f"({t})"),
        inner.map(lambda t: f"-{t}"),
        inner.map(lambda t: f" +{t} "),
    ),
    max_leaves=6,
)


@repeatable
@given(texts)
def test_as_python_does_it(text):
    """As Python computes with floats: integers of a law file are floats too."""
    try:
        expected = eval(
            compile(text.strip(), "", "eval"), {"__builtins__": {}}, dict(NUMBERS)
        )  # safe: the text has only numbers, names and operators, see above
        expected = expected if isinstance(expected, complex) else float(expected)
    except ArithmeticError:
        expected = math.nan
    if isinstance(expected, complex) or not math.isfinite(expected):
        with pytest.raises(LawError, match=r"^phi_22\.k: "):
            evaluate("phi_22.k", text, NUMBERS)
    else:
        assert evaluate("phi_22.k", text, NUMBERS) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("2 * H * D_p", 2 * 8.36 * 0.01),
        ("-k ** 2", -6.25),
        ("(1 + 2) / 4", 0.75),
        ("  H", 8.36),
        ("1e-3", 1e-3),
        ("+1", 1.0),
        (3, 3.0),
        (0.25, 0.25),
    ],
)
def test_values(text, value):
    assert evaluate("k", text, NUMBERS) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "is no arithmetic expression"),
        ("2 *", "is no arithmetic expression"),
        ("a\0b", "is no arithmetic expression"),
        ("(" * 300 + "1" + ")" * 300, "is no arithmetic expression"),
        ("-" * 50_000 + "1", ""),
        ("+".join(["1"] * 5000), "nested too deeply"),
        ("J", "unknown parameter 'J'; known: ['D_p', 'H', 'k']"),
        ("abs(1)", "'abs(1)': only + - * / ** ( ), numbers and names"),
        ("H.real", "'H.real': only"),
        ("H[0]", "'H[0]': only"),
        ("__import__('os').system('true')", "only + - * / ** ( )"),
        ("1 if H else 2", "only"),
        ("lambda: 1", "only"),
        ("[1 for _ in (1,)]", "only"),
        ("(1, 2)", "only"),
        ("True", "only"),
        ("'a'", "only"),
        ("1j", "only"),
        ("7 % 2", "only"),
        ("7 // 2", "only"),
        ("1 < 2", "only"),
        ("H and k", "only"),
        ("~1", "only"),
        ("(x := 1)", "only"),
        ("1 / 0", "division by zero"),
        ("0 ** -1", "'0 ** -1':"),
        ("10.0 ** 400", "'10.0 ** 400':"),
        ("k ** 0.5", "not a finite number"),
        ("1e308 * 10", "gives inf, not a finite number"),
        ("9" * 400, "too large"),
        (math.nan, "gives nan, not a finite number"),
        (math.inf, "gives inf, not a finite number"),
    ],
)
def test_anything_else_is_refused(text, why):
    with pytest.raises(LawError) as caught:
        evaluate("phi_22.k", text, NUMBERS)
    assert caught.value.where == "phi_22.k"
    assert why in caught.value.why


@repeatable
@given(st.text(max_size=20))
def test_any_text_gives_a_number_or_a_law_error(text):
    with contextlib.suppress(LawError):
        assert math.isfinite(evaluate("k", text, NUMBERS))
