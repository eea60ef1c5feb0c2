"""The tick of a law in C: functions of the kernel or of fixed point, and what they work on.

In a law of its own the constants are numbers in the code; in the generic step they are those of the
law's record. Variables that a tick leaves are members of an instance ``s``, the others of ``t``.
"""

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from gfm_runtime import kernel
from gfm_runtime.counts import COUNTS_NUMBERS, COUNTS_STATE, align, calibrate, measure, modulate
from gfm_runtime.firmware import fixed
from gfm_runtime.firmware.translate import (
    Algebra,
    Array,
    CFunction,
    Expr,
    Printer,
    Struct,
    Translator,
    constants,
    number,
    operations,
    with_callees,
    without_unread,
)
from gfm_runtime.inner import INNER_NUMBERS, INNER_STATE, stage
from gfm_runtime.signals import N_ADC, N_LEGS, NU, NU_INNER, NY, NY_INNER, group
from gfm_runtime.switchover import settle_into, settle_with_inner

#: numbers of an inner stage in an instance
SIZE = sum(size for _, size, _ in INNER_STATE)
#: constants that are the same in all laws, and no members of a law's record in C
SHARED = ("one",)
INTEGERS = (
    "n",
    "error_map",
    "row",
    "limited",
    "suspect",
    "age",
    "since",
    *(name for name, _ in (*INNER_NUMBERS, *COUNTS_NUMBERS)),
)
#: variables of one tick only: by the name in ``state_dtype``, the name in C and what it is
_OF_A_TICK = {
    "ref": ("ref", "references as given"),
    "r": ("r", "references after the error map"),
    "y": ("y", "measurements after the error map; omega_u is the law's own"),
    "raw": ("raw", "u before the limits"),
    "now": ("u", "u within the limits"),
    "x_next": ("x_next", "states of the next tick"),
    "m": ("m", "measurements that the inner stage uses"),
    "omega": ("omega", "omega_u after the power limiter"),
    "drop": ("drop", "voltage over the threshold impedance"),
    "push": ("push", "what a stiff source adds to the integrator of E_u"),
    "e_now": ("e", "the bridge's voltage"),
    "suspect": ("suspect", "channel of the A/D that is not plausible, or -1"),
    "phases": ("phases", "what the A/D has read, p.u."),
    "legs": ("legs", "along the axes of the legs"),
    "edges": ("edges", "ripple of the currents at their legs' edges down"),
    "compare": ("compare", "compare values, and a half"),
}
_PLACES = ("V_DC", "P", "OMEGA", "I_D", "I_Q", "V_D", "V_Q", "I_OD", "I_OQ")
assert [getattr(stage, name) for name in _PLACES] == list(range(len(_PLACES)))


def place(name: str, shape: tuple[int, ...], at: str) -> Expr | Array:
    """A field of a record in C."""
    kind = "int" if name in INTEGERS else "real"
    return Array(at, shape, kind) if shape else Expr("var", (at,), kind)


def _state(real: np.dtype[Any], n: int) -> Struct:
    of = kernel.state_dtype(real)
    inside = {name: "stage" for name, *_ in INNER_STATE}
    inside |= {name: "counts" for name, *_ in COUNTS_STATE}
    fields = {}
    for name in of.names or ():
        shape = of[name].shape if not name.startswith("x_n") else (n,)
        own = f"t->{_OF_A_TICK[name][0]}" if name in _OF_A_TICK else f"s->{name}"
        fields[name] = place(name, shape, f"s->{inside[name]}.{name}" if name in inside else own)
    return Struct(fields)


class Tick:
    """The functions of a law's tick.

    Args:
        record: the law as ``pack_law`` gives it; None for the generic step.
        real: float32 or float64.
        n: states that an instance has room for.
        stages: whether it has an inner stage's variables.
        counts: whether it measures and modulates.
        tuned: fields of the law whose numbers are coefficients in RAM, by ``GainChanges.fields``.
        all_terms: count zeros too, as the generic step does.
    """

    def __init__(
        self,
        record: np.void | None,
        real: np.dtype[Any],
        n: int,
        stages: bool,
        all_terms: bool = False,
        counts: bool = False,
        tuned: Mapping[str, Any] | None = None,
    ) -> None:
        self._n, own = n, record is not None
        of = kernel.law_dtype(real)  # the constants as members of a record in C
        fields = {name: place(name, of[name].shape, f"law->{name}") for name in of.names or ()}
        fields |= {name: number(1.0) for name in SHARED}
        if not stages:  # those of none
            fields |= {name: number(0) for name, _ in INNER_NUMBERS} | {"k_pll": number(0.0)}
        law = Struct(fields)
        if record is not None:
            constant = {name: record[name] for name in record.dtype.names or ()}
            law = Struct(constant | dict(tuned or {}))
            all_terms = all_terms or bool(np.any(np.signbit(record["u_0"]) & (record["u_0"] == 0)))
        translate = Translator(own, Algebra(all_terms))
        records = [law, _state(real, n)]
        ref, y = Array("ref", (NY,)), Array("y", (NY_INNER if stages else NY,))
        u, trend = Array("u", (NU,)), Array("trend", (NU,))
        out = Array("out", (NU_INNER if stages else NU,))
        e = [Expr("var", (f"e[{k}]",)) for k in range(2)] if stages else []
        self.look = translate.function(kernel.look, [*records, ref, y, u])
        self.output, self.advance = self.look, translate.function(kernel.advance, records)
        if stages:
            self.output = translate.function(kernel.look_with_inner, [*records, ref, y, out])
            self.advance = translate.function(kernel.advance_with_inner, records)
        self.settle = translate.function(
            settle_with_inner if stages else settle_into, [*records, ref, y, u, trend, *e]
        )
        self._counts = []
        if counts:
            adc = [*records, Array("adc", (N_ADC,)), number(0)]
            self._counts = [
                translate.function(measure, adc),
                translate.function(modulate, records),
                translate.function(align, adc),
                translate.function(calibrate, adc),
            ]
        entries = [self.output, self.advance, self.look, self.settle, *self._counts]
        self._functions = with_callees(entries)
        without_unread(self._functions, "t->")
        self._real, self._own = real, own

    def keys(self, prefix: str) -> dict[str, str]:
        """What the templates ask for: the variables of a tick, the functions, and their calls."""
        roots = {} if self._own else {"law": "gfm_law_t"}
        roots |= {"s": f"{prefix}_t", "t": "tick_t"}
        printer = Printer(self._real, roots, {"t->m": _PLACES})

        def call(one: CFunction, t: str = "&t", **at: str) -> str:
            names = [p.place if isinstance(p, Array) else p.name for p in one.parameters]
            return printer.call(one, [at.get(name, name) for name in names], {"t": t})

        sizes = {"raw": NU, "now": NU, "m": len(_PLACES), "drop": 2, "e_now": 2, "x_next": self._n}
        sizes |= {"phases": N_ADC, "legs": N_LEGS, "edges": N_LEGS, "compare": N_LEGS}
        used = {e.args[0] for f in self._functions for e in f.places()}
        lines = ["typedef struct {"]
        for key, (name, what) in _OF_A_TICK.items():
            if f"t->{name}" in used:
                size = f"[{sizes.get(key, NY)}]" * (key not in ("omega", "push", "suspect"))
                kind = "int" if key in INTEGERS else "real"
                lines.append(f"    {kind} {name}{size}; /* {what} */")
        if "t->c" in used:
            lines.append("    const real *c; /* the coefficients in use */")
        lines += ["} tick_t;", ""]
        if "t->m" in used:
            lines += [f"enum {{ {', '.join(_PLACES)} }}; /* of m in a tick */", ""]
        at = "t" if self._counts else "&t"  # one tick may be part of another function
        names = ("MEASURE", "MODULATE", "ALIGN", "CALIBRATE")[: len(self._counts)]
        counts = {
            name: call(one, "t" if name == "MEASURE" else "&t", adc="counts", first="0")
            for name, one in zip(names, self._counts, strict=True)
        }
        return counts | {
            "TICK": "\n".join(lines),
            "FUNCTIONS": "\n".join(map(printer.function, self._functions)),
            "OUTPUT": call(self.output, at, u="out"),
            "ADVANCE": call(self.advance, at),
            "LOOK": call(self.look),
            "SETTLE": call(self.settle, e_d="e[0]", e_q="e[1]"),
        }

    def operations(self) -> Mapping[str, int]:
        """Operations of a step by their signs, see ``translate.operations``."""
        entries = (*self._counts[:2], self.output, self.advance)
        return sum(map(operations, entries), Counter())

    def constants(self) -> int:
        """Different constants of a step."""
        entries = (*self._counts[:2], self.output, self.advance)
        return len(set[float]().union(*map(constants, entries)))


_PRIMITIVES = {"rounded": "wide", "between": "word", "root": "wide"}


def _place(one: fixed.Number) -> Expr:
    at = re.fullmatch(r"(.*)\[(\d+)\]", one.text)
    return Expr("var", (at[1], number(int(at[2]))), "word") if at else number(0)


class FixedTick:
    """The functions of the tick of a law in fixed point."""

    def __init__(self, law: fixed.FixedLaw) -> None:
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
        self.set_inputs = translate.function(fixed.set_inputs, [law, v, w])
        self.output = translate.function(fixed.output, [law, v, w])
        self.look = translate.function(fixed.look, [law, v, w, u])
        self.advance = translate.function(fixed.advance, [law, v, w])
        self.settle = translate.function(fixed.settle, [law, v, w, u, trend])
        self.reset = translate.function(fixed.begin_rests, [law, w])
        self.bump = translate.function(fixed.bump_of, [old, u])

    def keys(self, prefix: str) -> dict[str, str]:
        """What the templates ask for: the variables of a tick, the functions, and their calls."""
        printer = Printer(np.dtype("f8"), {"s": f"{prefix}_t", "t": "tick_t"})

        def call(one: CFunction, *arguments: str) -> str:
            return printer.call(one, arguments, {"t": "&t"})

        functions = with_callees([self.reset, self.look, self.advance, self.settle, self.bump])
        return {
            "FUNCTIONS": "\n".join(map(printer.function, functions)),
            "RESET": call(self.reset),
            "OUTPUT": "".join(
                f"{call(one)};\n    " for one in (self.set_inputs, self.output) if one.body
            ).removesuffix(";\n    "),
            "ADVANCE": call(self.advance),
            "LOOK": call(self.look, "u"),
            "SETTLE": call(self.settle, "u", "trend"),
            "BUMP": call(self.bump, "old", "u"),
        }

    def operations(self) -> Mapping[str, int]:
        """Operations of a step by their signs, see ``translate.operations``."""
        return sum(map(operations, (self.set_inputs, self.output, self.advance)), Counter())

    def formats(self, guard: str) -> list[str]:
        """The exponents of the signals, as C."""
        trends = self._law.numbers[fixed.TREND : fixed.TREND + NU]
        numbers = {"REF": fixed.REFS, "Y": fixed.YS, "U": fixed.US, "TREND": trends}
        signals = {"REF": group("ref"), "Y": group("y"), "U": group("u"), "TREND": group("u")}
        qs = {
            f"{vector}_{s.name}".upper(): one.q
            for vector, many in numbers.items()
            for s, one in zip(signals[vector], many, strict=True)
        }
        names = [f"    {guard}_Q_{name} = {q}" for name, q in (qs | {"BUMP": fixed.BUMP_Q}).items()]
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
        bounds = (
            end
            for one in (*fixed.US, *self._law.numbers[fixed.TREND :])
            for end in (one.low, one.high)
        )
        return ", ".join(dict.fromkeys(map(str, bounds)))
