"""Inputs near valid ones: text changed word by word, tables value by value, bytes bit by bit."""

import contextlib
import copy
import re
from collections.abc import Iterator, Sequence
from typing import Any

from hypothesis import strategies as st

from gfm_hil.scenario import toml_text

_WORD = re.compile(r'"(?:\\.|[^"\\\n])*"|[A-Za-z_@][\w.-]*@?|[-+]?\d[\w.+-]*|\s+|.', re.DOTALL)
_DEPTH = 3000

#: words that often break parsers, in TOML or in JSON
NASTY = (
    *("0", "-1", "1e308", "1e999", "-0.0", "NaN", "nan", "inf", "Infinity", "0x7f", "1_000"),
    *(str(2**31), str(2**63 - 1), str(2**63), str(2**64), "9" * 30, "9" * 400, "9" * 5000),
    *("true", "null", "[]", "{}", '""', "[[]]", '{"a": 1}', "[1, 2]", "1979-05-27T07:32:00Z"),
    "[" * _DEPTH + "]" * _DEPTH,
    "[" * _DEPTH,
    '{"a":' * _DEPTH,
    "{a=" * _DEPTH,
    "a." * _DEPTH + "a = 1",
    *(
        f'"{text}"'
        for text in (r"\u001b[2J", r"\u0000", r"\ud800", "\u202e", "é" * 300, "x" * 5000)
    ),
    *('"../../etc/passwd"', '"nan"', '"__class__"', '"\\\\"'),
    *("\x1b[2J", "\x00", "\ufeff", "\r\n", "'''", *"'\"#=[]{},\\"),
)


@st.composite
def texts(draw: st.DrawFn, seeds: Sequence[str], also: Sequence[str] = ()) -> bytes:
    """A seed in which a few words were replaced, added, removed or swapped.

    Args:
        draw: of hypothesis.
        seeds: valid texts.
        also: words besides the nasty ones.
    """
    words = _WORD.findall(draw(st.sampled_from(seeds)))
    new = st.sampled_from((*also, *NASTY)) | st.sampled_from(words) | st.text(max_size=8)
    for _ in range(draw(st.integers(1, 4))):
        if not words:
            break
        solid = [k for k, word in enumerate(words) if not word.isspace()] or [0]
        at = draw(st.sampled_from(solid))
        match draw(st.sampled_from(("replace", "replace", "insert", "leave out", "repeat", "end"))):
            case "replace":
                words[at] = draw(new)
            case "insert":
                words.insert(at, draw(new))
            case "leave out":
                del words[at]
            case "repeat":
                upto = draw(st.integers(at, min(len(words), at + 30)))
                words[at:at] = words[at:upto]
            case "end":
                del words[at:]
    whole = "".join(words).encode("utf-8", "surrogatepass")
    return draw(blobs([whole])) if draw(st.integers(0, 9)) == 0 else whole


#: values that some field cannot have; "@date" becomes a date
WEIRD = st.one_of(
    st.sampled_from([0, -1, 2**31, 2**63 - 1, 2**63, 10**29, 10**400, -(10**400)]),
    st.sampled_from([0.0, -0.0, -1.0, 1e300, -1e300, 1e-300, 5e-324, 1e12, 1e-12]),
    st.sampled_from([float("nan"), float("inf"), -float("inf")]),
    st.sampled_from(["", " ", "a" * 300, "a\0b", "a\nb", "é", "/dev/zero", "P_ref", "1 / D_p"]),
    st.sampled_from([True, False, [], {}, [[]], [[1.0]], {"a": 1}, [1] * 100, ["x"], "@date"]),
    st.floats(),
    st.integers(-3, 10**6),
)


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of every value in nested tables and arrays."""
    items: Any = ()
    if isinstance(content, dict):
        items = content.items()
    elif isinstance(content, list):
        items = enumerate(content)
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


@st.composite
def tables(draw: st.DrawFn, seeds: Sequence[dict[str, Any]]) -> bytes:
    """TOML in which one to three values of a valid file were replaced or removed."""
    content = copy.deepcopy(draw(st.sampled_from(seeds)))
    paths = st.sampled_from(list(places(content)))
    for path, value in draw(st.lists(st.tuples(paths, st.none() | WEIRD), min_size=1, max_size=3)):
        at: Any = content
        with contextlib.suppress(KeyError, IndexError, TypeError):  # changed before
            for key in path[:-1]:
                at = at[key]
            last = str(path[-1]) if isinstance(at, dict) else path[-1]
            if value is None:
                del at[last]
            else:
                at[last] = copy.deepcopy(value)  # else a list could contain itself
    return toml_text(content).replace('"@date"', "1979-05-27").encode()


@st.composite
def blobs(draw: st.DrawFn, seeds: Sequence[bytes], changes: int = 4) -> bytes:
    """A seed in which a few bits, bytes or numbers were changed, or that was cut or extended.

    Args:
        draw: of hypothesis.
        seeds: valid inputs.
        changes: most changes.
    """
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(0, changes))):
        at = draw(st.integers(0, len(data)))
        match draw(st.sampled_from(("bit", "byte", "number", "cut", "leave out", "insert", "add"))):
            case "bit" if at < len(data):
                data[at] ^= 1 << draw(st.integers(0, 7))
            case "byte" if at < len(data):
                data[at] = draw(st.sampled_from((0, 1, 127, 128, 254, 255)))
            case "number":
                width = draw(st.sampled_from((1, 2, 4, 8)))
                value = draw(st.sampled_from((0, 1, -1, 2 ** (8 * width - 1), 2**6, 99)))
                order = draw(st.sampled_from(("little", "big")))
                data[at : at + width] = (value % 2 ** (8 * width)).to_bytes(width, order)
            case "cut":
                del data[at:]
            case "leave out":
                del data[at : at + draw(st.integers(1, 16))]
            case "insert":
                data[at:at] = draw(st.binary(max_size=16))
            case "add":
                data += draw(st.sampled_from(seeds))
    return bytes(data)


def lines(one: st.SearchStrategy[bytes], most: int = 4) -> st.SearchStrategy[bytes]:
    """A few messages, one per line."""
    return st.lists(one, min_size=1, max_size=most).map(
        lambda many: b"\n".join(message.replace(b"\n", b" ") for message in many)
    )
