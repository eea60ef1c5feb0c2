"""The tick of a law in fixed point in C: ``fixed_tick``, translated."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

import numpy as np

from gfm_runtime.error_maps import HYBRID_ANGLE, LINEAR
from gfm_runtime.firmware import fixed_tick
from gfm_runtime.firmware.fixed import BUMP_Q, REFS, TREND, US, YS, FixedLaw, Number
from gfm_runtime.firmware.translate import (
    Array,
    CFunction,
    Expr,
    Printer,
    Struct,
    Translator,
    number,
    operations,
    reached,
)
from gfm_runtime.signals import NU, group

_PRIMITIVES = {"rounded": "wide", "between": "word", "root": "wide"}
_ROOT = """\
/* The integer below the square root of a number below 2^62. */
static int32_t root(int64_t square)
{
    int32_t below = 0;
    int bit;
    for (bit = 30; bit >= 0; bit--) {
        const int32_t next = below + (INT32_C(1) << bit);
        if (product(next, next) <= square) {
            below = next;
        }
    }
    return below;
}
"""


def _place(one: Number) -> Expr:
    at = re.fullmatch(r"(.*)\[(\d+)\]", one.text)
    return Expr("var", (at[1], number(int(at[2]))), "word") if at else number(0)


class FixedTick:
    """The functions of the tick of a law in fixed point."""

    def __init__(self, law: FixedLaw) -> None:
        self._law = law
        translate = Translator(True, primitives=_PRIMITIVES)
        v = tuple(map(_place, law.numbers))
        pairs = {name: Array(f"t->{name}", (2,), "wide") for name in ("a", "b", "turn")}
        w = Struct(
            {
                "raw": Array("t->raw", (NU,), "wide"),
                "x_next": Array("t->x_next", (law.n,), "word"),
                "rest": Array("s->rest", (2 * NU + law.n,), "wide"),
                **pairs,
            }
        )
        u, old, trend = (Array(name, (NU,), "word") for name in ("u", "old", "trend"))
        t = fixed_tick
        self.set_inputs = translate.function(t.set_inputs, [law, v, w])
        self.output = translate.function(t.output, [law, v, w])
        self.look = translate.function(t.look, [law, v, w, u])
        self.advance = translate.function(t.advance, [law, v, w])
        self.settle = translate.function(t.settle, [law, v, w, u, trend])
        self.reset = translate.function(t.begin_rests, [law, w])
        self.bump = translate.function(t.bump_of, [old, u])

    def keys(self, prefix: str) -> dict[str, str]:
        """What the templates ask for: the variables of a tick, the functions, and their calls."""
        printer = Printer(np.dtype("f8"), {"s": f"{prefix}_t", "t": "tick_t"})
        law = self._law
        lines = ["typedef struct {", "    const int32_t *ref, *y;"]
        if law.error_map != LINEAR:
            lines += ["    int32_t r[5], m[5]; /* what the error map makes of ref and of y */"]
        if law.error_map == HYBRID_ANGLE:
            lines += ["    int64_t a[2], b[2], turn[2]; /* directions of vectors */"]
        lines += [
            f"    int64_t raw[{NU}];    /* u before the limits, each row at its own exponent */",
            f"    int32_t excess[{NU}]; /* what the limits add to it, for the anti-windup */",
            f"    int32_t u[{NU}];",
            *([f"    int32_t x_next[{law.n}];"] if law.n else []),
            "} tick_t;",
            "",
        ]

        def call(one: CFunction, *arguments: str) -> str:
            return printer.call(one, arguments, {"t": "&t"})

        functions = reached([self.reset, self.look, self.advance, self.settle, self.bump])
        return {
            "TICK": "\n".join(lines),
            "ROOT": _ROOT if law.error_map == HYBRID_ANGLE else "",
            "FUNCTIONS": "\n".join(map(printer.function, functions)),
            "RESET": call(self.reset),
            "OUTPUT": "".join(
                f"{call(one)};\n    " for one in (self.set_inputs, self.output) if one.body
            ).removesuffix(";\n    "),
            "ADVANCE": call(self.advance),
            "LOOK": call(self.look, "u"),
            "SETTLE": call(self.settle, "u", "trend"),
            "BUMP": call(self.bump, "old", "u"),
            "IN_PLACE": "",
            "APART": "",
        }

    def operations(self) -> Mapping[str, int]:
        """Operations of a step by their signs, see ``translate.operations``."""
        return sum(map(operations, (self.set_inputs, self.output, self.advance)), Counter())

    def formats(self, guard: str) -> list[str]:
        """The exponents of the signals, as C."""
        trends = self._law.numbers[TREND : TREND + NU]
        numbers = {"REF": REFS, "Y": YS, "U": US, "TREND": trends}
        signals = {"REF": group("ref"), "Y": group("y"), "U": group("u"), "TREND": group("u")}
        qs = {
            f"{vector}_{s.name}".upper(): one.q
            for vector, many in numbers.items()
            for s, one in zip(signals[vector], many, strict=True)
        }
        names = [f"    {guard}_Q_{name} = {q}" for name, q in (qs | {"BUMP": BUMP_Q}).items()]
        return [
            "",
            "/* All numbers are integers: a value in p.u. is the number / 2^Q; the other way,",
            " * (int32_t)lrint(ldexp(value, Q)). A trend is in p.u. per tick. */",
            "enum {",
            ",\n".join(names),
            "};",
            "",
            f"enum {{ {guard}_NREST = {2 * NU + self._law.n} }};",
        ]

    def hints(self) -> str:
        """Where EVA stops widening: the bounds of the state."""
        bounds = (end for one in (*US, *self._law.numbers[TREND:]) for end in (one.low, one.high))
        return ", ".join(dict.fromkeys(map(str, bounds)))
