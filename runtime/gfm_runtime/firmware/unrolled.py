"""A law's step with its constants in the code, and without its zeros.

The sums are in the kernel's order (``gfm_runtime.kernel``), so the bits are the kernel's. A term
with the coefficient 0 can go: it adds +0 or -0, which changes no sum except one that is -0 itself.
A row of ``output`` starts with u_0 + offset, which is -0 only if u_0 is; then all terms stay. The
kernel makes the sums of ``advance`` and ``set_states`` +0 where they are -0. A factor of 1 can go.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from gfm_runtime.error_maps import DC_ENERGY, DVOC, HYBRID_ANGLE
from gfm_runtime.firmware.c_text import literal
from gfm_runtime.inner import NONE
from gfm_runtime.signals import NU, NY, U_NAMES

_MAPS = {DC_ENERGY: "dc_energy", DVOC: "dvoc", HYBRID_ANGLE: "hybrid_angle"}


class Unrolled:
    """The four functions of a law that differ from law to law.

    Args:
        record: the law as ``gfm_runtime.kernel.pack_law`` gives it, one element.
        stages: whether the instance has an inner stage's variables.
    """

    def __init__(self, record: np.void, stages: bool = False) -> None:
        self.law, self.n = record, int(record["n"])
        self._inner = stages and int(record["inner"]) != NONE
        self.real: np.dtype[Any] = record["u_0"].dtype

    def text(self, prefix: str) -> str:
        """The functions set_inputs, output, advance and set_states in C."""
        return "\n".join(
            [
                "static void set_inputs(tick_t *t, const real ref[], const real y[])",
                *body(self._set_inputs()),
                "/* A copy of its own for step saves it a call and the way through memory. */",
                "#ifdef __GNUC__",
                "#define IN_PLACE static inline __attribute__((always_inline))",
                "#else",
                "#define IN_PLACE static inline",
                "#endif",
                "",
                f"IN_PLACE void output(const {prefix}_t *s, tick_t *t)",
                *body(self._output()),
                f"static void advance({prefix}_t *s, const tick_t *t)",
                *body(self._advance()),
                f"static void set_states({prefix}_t *s, tick_t *t, const real u[])",
                *body(self._set_states()),
            ]
        )

    def step_lines(self) -> list[str]:
        """The statements of a step."""
        return [*self._set_inputs(), *self._output(), *self._advance()]

    @property
    def _zero(self) -> str:
        return "0.0f" if self.real == np.float32 else "0.0"

    def _number(self, value: Any) -> str:
        return literal(value, self.real)

    def _product(self, coefficient: Any, factor: str) -> str:
        if abs(coefficient) == 1:
            return factor if coefficient > 0 else f"-{factor}"
        return f"{self._number(coefficient)} * {factor}"

    def _products(self, row: Iterable[Any], factor: str, zeros: bool = False) -> list[str]:
        return [self._product(c, factor.format(j)) for j, c in enumerate(row) if c != 0 or zeros]

    def tick(self) -> str:
        """The members of a tick record that hold the inputs: mapped copies only if it must be."""
        members = ["    const real *ref; /* references as given */"]
        if self._mapped:
            members += [
                f"    real r[{NY}]; /* references after the error map */",
                f"    real y[{NY}]; /* measurements after the error map */",
            ]
        else:
            members += ["    const real *y;"]
        return "\n".join(members) + "\n"

    @property
    def _mapped(self) -> bool:
        return int(self.law["error_map"]) in _MAPS

    @property
    def _r(self) -> str:
        return "t->r[{}]" if self._mapped else "t->ref[{}]"

    def _set_inputs(self) -> list[str]:
        if not self._mapped:
            return ["t->ref = ref;", "t->y = y;"]
        lines = ["t->ref = ref;"]
        lines += [f"t->{v[0]}[{j}] = {v}[{j}];" for v in ("ref", "y") for j in range(NY)]
        code = int(self.law["error_map"])
        arguments = ""
        if code == HYBRID_ANGLE:
            R, X = map(self._number, self.law["error_parameters"])
            arguments = f"{R}, {X}, "
        return [*lines, f"{_MAPS[code]}({arguments}t->r, t->y);"]

    def _measured(self, row: Any, omega_u: str) -> list[str]:
        """Products with the measurements; of column 3 with the law's own omega_u."""
        return [
            product
            for j in range(NY)
            for product in self._products([row[j]], omega_u if j == 2 else f"t->y[{j}]")
        ]

    def _row(self, i: int) -> list[str]:
        """The terms of u_i without the column of omega_u."""
        law = self.law
        zeros = bool(law["u_0"][i] == 0 and np.signbit(law["u_0"][i]))
        terms = [f"({self._number(law['u_0'][i])} + s->offset[{i}])"]
        terms += self._products(law["C"][i, : self.n], "s->x[{}]", zeros)
        for j in range(NY):
            pair = self._products([law["D_u0"][i, j]], f"t->ref[{j}]", zeros)
            pair += self._products([law["D_r"][i, j]], self._r.format(j), zeros)
            if pair:
                terms.append(pair[0] if len(pair) == 1 else f"({_sum(pair)})")
        for j in (0, 1, 3, 4):
            terms += self._products([law["D_y"][i, j]], f"t->y[{j}]", zeros)
        return terms

    def _output(self) -> list[str]:
        law, lines = self.law, []
        for i in (1, 0, 2):  # omega_u first: column 3 feeds it back
            total = _sum(self._row(i))
            if i == 1:
                total = total if law["loop"] == 1 else f"({total}) * {self._number(law['loop'])}"
            else:
                total = _sum([total, *self._products([law["D_y"][i, 2]], "t->u[1]")])
            low, high = self._number(law["low"][i]), self._number(law["high"][i])
            ends = (f"{float(law[end][i]):g}" for end in ("low", "high"))
            lines.append(f"/* {U_NAMES[i]}, {' to '.join(ends)} p.u. */")
            lines.append(f"t->raw[{i}] = {total};")
            lines.append(f"t->u[{i}] = limited(t->raw[{i}], {low}, {high});")
        return lines

    def _advance(self) -> list[str]:
        law, n = self.law, self.n
        decay, follow = self._number(law["decay"]), self._number(law["follow"])
        lines = [f"real {', '.join(f'x{i}' for i in range(n))};"] if n else []
        for i in range(NU):
            moved = [j for j in range(n) if law["W"][j, i] != 0]
            u = "t->omega" if self._inner and i == 1 else f"t->u[{i}]"  # the power limiter moves it
            if moved:
                lines.append(f"if ({u} - t->raw[{i}] != {self._zero}) {{ /* back-calculation */")
                for j in moved:
                    term = self._product(law["W"][j, i], f"({u} - t->raw[{i}])")
                    lines.append(f"    s->x[{j}] += {term};")
                lines.append("}")
        for i in range(NU):
            lines.append(f"s->offset[{i}] = faded(s->offset[{i}] * {decay});")
            change = f"{follow} * (t->u[{i}] - s->u[{i}] - s->trend[{i}])"
            lines.append(f"s->trend[{i}] = faded(s->trend[{i}] + {change});")
            lines.append(f"s->u[{i}] = t->u[{i}];")
        for i in range(n):
            terms = self._products(law["B_r"][i], self._r)
            terms += self._measured(law["B_y"][i], "t->u[1]")
            terms += self._products(law["A"][i, :n], "s->x[{}]")
            lines.append(f"x{i} = {_sum(terms) or self._zero};")
        frozen = (
            [i for i in range(n) if law["row"][i] == 2] if self._inner and law["freeze"] else []
        )
        lines += [f"s->x[{i}] = faded(x{i});" for i in range(n) if i not in frozen]
        if frozen:  # a move of E_u towards v lets the current leave its limit
            moves = [
                self._product(law["C"][2, i], f"(x{i} - s->x[{i}])")
                for i in frozen
                if law["C"][2, i] != 0
            ]
            away = f"({_sum(moves) or self._zero}) * (t->u[2] - s->stage.v_f[0]) > {self._zero}"
            lines += [f"if (!(s->limited && {away})) {{"]
            lines += [*(f"    s->x[{i}] = faded(x{i});" for i in frozen), "}"]
        return lines

    def _set_states(self) -> list[str]:
        law, n = self.law, self.n
        used = [j for j in range(NU) if law["F"][:n, j].any()]
        lines = []
        for j in used:
            wanted = [f"u[{j}]"]
            if law["u_0"][j] != 0:
                wanted.append(self._number(law["u_0"][j]))
            wanted += self._products(law["D_u0"][j], "t->ref[{}]")
            lines.append(f"const real wanted{j} = {' - '.join(wanted)};")
        for i in range(n):
            terms = self._products(law["E_r"][i], self._r)
            terms += self._measured(law["E_y"][i], "u[1]")
            for j in range(NU):
                pair = self._products([law["F"][i, j]], f"wanted{j}")
                pair += self._products([law["G"][i, j]], f"s->trend[{j}]")
                if pair:
                    terms.append(pair[0] if len(pair) == 1 else f"({_sum(pair)})")
            total = _sum(terms)
            lines.append(
                f"s->x[{i}] = {f'{total} + {self._zero}' if terms else self._zero}; /* never -0 */"
            )
        text = "\n".join(lines)
        unused = [
            name for name, use in (("s", "s->"), ("t", "t->"), ("u", "u[")) if use not in text
        ]
        return lines + [f"(void){name};" for name in unused]


def _sum(terms: Sequence[str]) -> str:
    """A sum from the left. a - c x is a + (-c) x to the bit, and c is often there already."""
    return "".join(
        (f" - {term[1:]}" if term.startswith("-") else f" + {term}") if k else term
        for k, term in enumerate(terms)
    )


def body(lines: list[str]) -> list[str]:
    """A function's body; long sums go on over several lines."""
    out = ["{"]
    for line in lines:
        while len(line) > 92:
            at = max(line.rfind(sign, 20, 92) for sign in (" + ", " - "))
            out.append(f"    {line[:at]}")
            line = f"   {line[at:]}"
        out.append(f"    {line}")
    return [*out, "}", ""]
