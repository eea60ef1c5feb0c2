"""A law in fixed point as C99, and the harness with which Frama-C proves it free of overflow."""

from __future__ import annotations

from collections.abc import Sequence

from gfm_runtime.error_maps import DC_ENERGY, DVOC, ERROR_MAPS, HYBRID_ANGLE, LINEAR
from gfm_runtime.firmware.c_text import body, chosen, filled, template
from gfm_runtime.firmware.fixed import (
    BUMP_Q,
    EXCESS,
    OFFSET,
    REFS,
    TREND,
    U_DEFAULT,
    US,
    YS,
    FixedLaw,
    M,
    Number,
    R,
    Sum,
    U,
    X,
    ratio_of,
)
from gfm_runtime.firmware.module import FIXED_CHOICES, MADE, Module, about, keys_of
from gfm_runtime.signals import NU, U_NAMES, group

ROWS = (1, 0, 2)  # of u: omega_u first, since column 3 feeds it back


def fixed_sources(modules: Sequence[Module], T_s: float) -> dict[str, str]:
    """The headers and sources of laws in fixed point by file name, and their proofs."""
    files: dict[str, str] = {}
    for m in modules:
        keys = _keys(m)
        files[f"{m.prefix}.h"] = (
            about(m, T_s)
            + "\n"
            + filled(chosen(template("interface.h"), FIXED_CHOICES), keys).replace("\n\n\n", "\n")
        )
        files[f"{m.prefix}.c"] = filled(template("fixed.c"), keys)
        files[f"proof/{m.prefix}.c"] = filled(template("proof.c"), keys | {"MADE": MADE})
    return files


def needs(m: Module) -> FixedLaw:
    """The numbers of a module in fixed point."""
    assert m.fixed is not None
    return m.fixed


def _keys(m: Module) -> dict[str, str]:
    law, guard = needs(m), m.prefix.upper()
    keys = keys_of(m)
    formats = [
        *((f"REF_{s.name}", one) for s, one in zip(group("ref"), REFS, strict=True)),
        *((f"Y_{s.name}", one) for s, one in zip(group("y"), YS, strict=True)),
        *((f"U_{s.name}", one) for s, one in zip(group("u"), US, strict=True)),
        *(
            (f"TREND_{s.name}", one)
            for s, one in zip(group("u"), law.numbers[TREND : TREND + NU], strict=True)
        ),
    ]
    qs = [(name.upper(), one.q) for name, one in formats] + [("BUMP", BUMP_Q)]
    return keys | {
        "LAW": "",
        "TYPES": "",
        "C_REAL": "int32_t",
        "SIGNALS": "\n".join(
            [
                keys["SIGNALS"],
                "",
                "/* All numbers are integers: a value in p.u. is the number / 2^Q; the other way,",
                " * (int32_t)lrint(ldexp(value, Q)). A trend is in p.u. per tick. */",
                "enum {",
                ",\n".join(f"    {guard}_Q_{name} = {q}" for name, q in qs),
                "};",
                "",
                f"enum {{ {guard}_NREST = {2 * NU + law.n} }};",
            ]
        ),
        "TICK": _tick(law),
        "MAP": _map(law),
        "CHECKS": "\n".join(_checks(guard)),
        "U_DEFAULT": ", ".join(map(str, U_DEFAULT)),
        "FUNCTIONS": "\n".join(
            [
                "static void set_inputs(tick_t *t, const int32_t ref[], const int32_t y[])",
                *body([*_mapping(law), "t->ref = ref;", "t->y = y;"]),
                f"static void output(const {m.prefix}_t *s, tick_t *t)",
                *body(_output(law)),
                f"static void advance({m.prefix}_t *s, const tick_t *t)",
                *body(_advance(law)),
                f"static void set_states({m.prefix}_t *s, const tick_t *t)",
                *body(_set_states(law)),
            ]
        ),
        "HALVES": ",\n        ".join(_wide(half) for half in law.halves()),
        "WANTED": "\n".join(_wanted(law)),
        "OFFSETS": "\n".join(_offsets(law)),
        "BUMPS": "\n".join(_bumps()),
        "HINTS": ", ".join(
            dict.fromkeys(
                str(end) for one in (*US, *law.numbers[TREND:]) for end in (one.low, one.high)
            )
        ),
    }


def _tick(law: FixedLaw) -> str:
    lines = ["    const int32_t *ref;", "    const int32_t *y;"]
    if law.error_map != LINEAR:
        lines += ["    int32_t r[5]; /* what the error map makes of ref */"]
        lines += ["    int32_t m[5]; /* and of y */"]
    return "\n".join([*lines, ""])


def _map(law: FixedLaw) -> str:
    """The function of an error map."""
    names = [name for name, code in ERROR_MAPS.items() if code and code == law.error_map]
    _, *parts = template("fixed_maps.c").split("/* @map ")
    by_name = dict(part.split("@ */\n", 1) for part in parts)
    return "".join(by_name[name] for name in names)


def _mapping(law: FixedLaw) -> list[str]:
    """What set_inputs does for an error map."""
    lines = []
    for vector, out, many, place in (("ref", "r", REFS, R), ("y", "m", YS, M)):
        if law.error_map == DC_ENERGY:
            shift = 2 * many[0].q + 1 - law.numbers[place].q
            lines.append(f"t->{out}[0] = half_square({vector}[0], {shift});")
        if law.error_map == DVOC:
            for j in (1, 3):
                one = law.numbers[place + j]
                of = ratio_of(many[j], many[4], one)
                lines.append(
                    f"t->{out}[{j}] = over_square({vector}[{j}], {vector}[4], {of.least}, "
                    f"{_wide(1 << of.first)}, {_wide(of.most)}, {_wide(1 << of.second)}, "
                    f"{one.high});"
                )
    if law.error_map == HYBRID_ANGLE:
        arguments = []
        for vector, (R_pu, X_pu) in zip(("ref", "y"), law.across, strict=True):
            p, q, V = (f"{vector}[{j}]" for j in (1, 3, 4))
            arguments += [
                f"product({V}, {V}) - product({R_pu}, {p}) - product({X_pu}, {q})",
                f"product({X_pu}, {p}) - product({R_pu}, {q})",
            ]
        lines += [
            f"const int64_t {name} = {text};"
            for name, text in zip(("x_a", "y_a", "x_b", "y_b"), arguments, strict=True)
        ]
        lines = [*lines, "t->r[1] = sine_of_half(x_a, y_a, x_b, y_b);"]
    return lines


def _range(one: Number) -> str:
    return f"{one.low}, {one.high}"


def _wide(value: int) -> str:
    return f"INT64_C({value})"


def text_of(total: Sum, law: FixedLaw, first: str = "") -> str:
    """A sum in C."""
    terms = [first] if first else []
    terms += [_wide(total.start)] if total.start or not (terms or total.terms) else []
    terms += [f"product({c}, {law.numbers[place].text})" for c, place in total.terms]
    return " + ".join(terms)


def _checks(guard: str) -> list[str]:
    lines = []
    for letter, many, signals in (("Y", YS, group("y")), ("REF", REFS, group("ref"))):
        for j, (one, s) in enumerate(zip(many, signals, strict=True)):
            value = one.text.removeprefix("t->")
            lines += [
                f"    if ({value} < {one.low} || {value} > {one.high}) {{ "
                f"/* {s.name}, {s.low:g} to {s.high:g} p.u. */",
                f"        *channel = {j};",
                f"        return {guard}_BAD_{letter};",
                "    }",
            ]
    return lines


def _output(law: FixedLaw) -> list[str]:
    lines = []
    for i in ROWS:
        total, to_excess = law.output[i], law.shift(law.output[i], EXCESS + i)
        shift = law.shift(total, U + i)
        low, high = (_wide(limit << shift) for limit in (law.low[i], law.high[i]))
        ends = (f"{limit / 2 ** US[i].q:g}" for limit in (law.low[i], law.high[i]))
        lines += [
            f"/* {U_NAMES[i]}, {' to '.join(ends)} p.u. */",
            f"t->raw[{i}] = {text_of(total, law)};",
            f"if (t->raw[{i}] > {high}) {{",
            f"    t->u[{i}] = {law.high[i]};",
            f"    t->excess[{i}] = (int32_t)rounded({high} - t->raw[{i}], {to_excess});",
            f"}} else if (t->raw[{i}] < {low}) {{",
            f"    t->u[{i}] = {law.low[i]};",
            f"    t->excess[{i}] = (int32_t)rounded({low} - t->raw[{i}], {to_excess});",
            "} else {",
            f"    t->u[{i}] = (int32_t)rounded(t->raw[{i}], {shift});",
            f"    t->excess[{i}] = 0;",
            "}",
        ]
    return lines


def _advance(law: FixedLaw) -> list[str]:
    """Increments of the offset, the trend and x: the upper bits now, the others in later ticks."""
    lines = ["int64_t now;"]
    lines += [f"int32_t {', '.join(f'x{k}' for k in range(law.n))};"] * (law.n > 0)
    for k, (total, place) in enumerate(law.moving()):
        one, shift = law.numbers[place], law.shift(total, place)
        to = f"x{place - X}" if place >= X else one.text
        moves = [
            f"now = {text_of(total, law, f's->rest[{k}]')};",
            f"{to} = between({one.text} + (now >> {shift}), {_range(one)});",
            f"s->rest[{k}] = now & {_wide((1 << shift) - 1)};",
        ]
        if OFFSET <= place < X:  # at 0 it does not move
            moves = [f"if ({one.text} != 0) {{", *(f"    {line}" for line in moves), "}"]
        lines += moves
    return [*lines, *(f"s->x[{k}] = x{k};" for k in range(law.n))]


def _set_states(law: FixedLaw) -> list[str]:
    lines = []
    for k, total in enumerate(law.settle):
        one, shift = law.numbers[X + k], law.shift(total, X + k)
        lines.append(
            f"s->x[{k}] = between(rounded({text_of(total, law)}, {shift}), {_range(one)});"
        )
    text = "\n".join(lines)
    return lines + [f"(void){name};" for name in ("s", "t") if f"{name}->" not in text]


def _wanted(law: FixedLaw) -> list[str]:
    lines = []
    for i, total in enumerate(law.last):
        trend, shift = law.numbers[TREND + i], law.shift(total, U + i)
        lines += [
            f"    wanted[{i}] = between(u[{i}], {_range(US[i])});",
            f"    t.u[{i}] = wanted[{i}];",
            f"    s->trend[{i}] = between(trend[{i}], {_range(trend)});",
            f"    s->u[{i}] = between(rounded({text_of(total, law)}, {shift}), {_range(US[i])});",
        ]
    return [line.replace("t->u", "t.u") for line in lines]


def _offsets(law: FixedLaw) -> list[str]:
    lines = []
    for rows in ((1,), (0, 2)):
        lines.append("    output(s, &t);")
        for i in rows:
            e, one = law.output[i].e, law.numbers[OFFSET + i]
            missing = f"wanted[{i}] * {_wide(1 << (e - US[i].q))} - t.raw[{i}]"
            lines += [
                f"    s->offset[{i}] = between(rounded({missing}, {e - one.q}),",
                f"        {_range(one)});",
            ]
    return lines


def _bumps() -> list[str]:
    lines = []
    for i, one in enumerate(US):
        lines += [
            "    {",
            f"        int64_t change = (int64_t)u[{i}] - old[{i}];",
            f"        change = (change < 0 ? -change : change) >> {one.q - BUMP_Q};",
            "        *bump = between(change, *bump, INT32_MAX);",
            "    }",
        ]
    return lines
