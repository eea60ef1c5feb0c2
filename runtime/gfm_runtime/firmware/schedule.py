"""A gain-scheduled law in C: its stages as modules, and one more that chooses between them.

It has the functions of a law, so that a model for EMT programs or an FMU takes it as one.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gfm_runtime.assembly import Controller
from gfm_runtime.catalogue import LawSet, law_file
from gfm_runtime.controller import choose
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import literals, plain, render
from gfm_runtime.firmware.module import Module, Style, keys_of, make_modules, sources, tunable
from gfm_runtime.firmware.tick import place
from gfm_runtime.firmware.translate import Array, Expr, Printer, Struct, Translator
from gfm_runtime.impedance import estimate
from gfm_runtime.signals import group


def stage_names(laws: LawSet) -> list[str]:
    """What the laws of a set are called, in their order."""
    if laws.schedule is None:
        return [laws.name]
    return [f"{laws.name}[{k}]" for k in range(len(laws.laws))]


def one_module(
    laws: LawSet, T_s: float, real: str, omega_b: float
) -> tuple[Module, dict[str, str]]:
    """A law or a scheduled one as what has its name, with its sources: in style tunable, or in
    unrolled if it is scheduled or its form follows from its gains. Raises LawError: as
    ``make_modules``."""
    if laws.schedule and laws.laws[0].counts:
        why = "is scheduled, which has no interrupt from counts; use its stages, or --counts none"
        raise LawError(f"law {laws.name!r}", why)
    modules = make_modules(dict(zip(stage_names(laws), laws.laws, strict=True)), T_s, real, omega_b)
    if laws.schedule is None:
        with contextlib.suppress(LawError):
            modules = [tunable(modules[0], law_file(laws.asked or laws.name), T_s)]
        return modules[0], sources(modules, T_s, "tunable")
    code = sources(modules, T_s, "unrolled")
    whole = replace(modules[0], name=laws.name)  # has the stages' signals
    return whole, code | schedule_sources(laws, modules, T_s, omega_b, "unrolled")


def schedule_sources(
    laws: LawSet, stages: Sequence[Module], T_s: float, omega_b: float, style: Style
) -> dict[str, str]:
    """The header and the source that choose between stages, by file name.

    Args:
        laws: with a schedule.
        stages: its laws as modules, in the same order.
        T_s, omega_b: as for ``make_modules``.
        style: of the modules.
    """
    schedule, m = laws.schedule, replace(stages[0], name=laws.name)
    assert schedule is not None and m.law is not None
    bench = Controller([laws], T_s, [s.default for s in group("ref")], omega_b=omega_b)
    ctl, n = bench.ctl[0], len(stages)
    double = np.dtype(np.float64)
    choices = {"stages": m.stages, "by_X": not schedule.by_V}
    own = style == "unrolled"
    parts = [
        (str(k), p.prefix if own else "gfm", "" if own else f"&{p.prefix}_law, ")
        for k, p in enumerate(stages)
    ]
    e = ", e" * m.stages

    def cases(text: str) -> str:
        return "\n".join(
            f"    case {k}:\n"
            + "".join(
                f"        {line}\n"
                for line in text.format(s=f"s->stage_{k}", t=t, law=law, e=e).splitlines()
            )
            + "        break;"
            for k, t, law in parts
        )

    copied = "(void)memcpy(trend, {s}.trend, sizeof {s}.trend);"
    if m.stages:
        copied += "\n(void)memcpy(e, {s}.stage.e, sizeof {s}.stage.e);"
    first = parts[0][1]
    keys = keys_of(m) | {
        "SOURCE": plain(m.law.source),
        "COUNT": str(len(stages)),
        "FIRST": first,
        "FIRST_GUARD": first.upper(),
        "INCLUDES": "\n".join(f'#include "{p.prefix}.h"' for p in stages),
        "MEMBERS": "\n".join(f"    {t}_t stage_{k};" for k, t, _ in parts),
        "E_OUT": ", real e[]" * m.stages,
        "E_MEMORY": ", e[2] = {0}" * m.stages,
        "LOOK": cases("(void){t}_look({law}&{s}, ref, y, u);\n" + copied),
        "SETTLE": cases("reason = {t}_settle({law}&{s}, ref, y, u, trend{e});"),
        "INIT": "\n".join(f"    {t}_init(&s->stage_{k});" for k, t, _ in parts),
        "RESET": cases("{t}_reset(&{s});"),
        "STEP": cases("s->reason = {t}_step({law}&{s}, ref, y, u);"),
        "START": str(ctl["active"]),
        "ABOVE": literals(ctl["above"][:n], double),
        "BELOW": literals(ctl["below"][:n], double),
        "X_0": repr(schedule.X_0),
        "QUANTITY": "voltage" if schedule.by_V else "estimated reactance of the grid",
        "AT_START": "nominal V" if schedule.by_V else f"the estimate X_0 = {schedule.X_0!r} p.u.",
        "FUNCTIONS": _functions(m.prefix, None if schedule.by_V else bench.est[0], ctl, n),
    }
    return {f"{m.prefix}{end}": render(f"schedule{end}", keys, choices) for end in (".h", ".c")}


def _functions(prefix: str, est: np.void | None, ctl: np.void, n: int) -> str:
    """The estimate of the reactance, if it is needed, and the choice of a stage, in C."""
    scheduled = Struct(
        {"stages": n, "by_V": ctl["by_V"], "dwell": ctl["dwell"],
         "since": place("since", (), "s->since")}
    )  # fmt: skip
    ends = [Array(name, (n,)) for name in ("above", "below")]
    now, at = Expr("var", ("now",), "int"), Expr("var", ("at",))
    translate = Translator(unroll=True)
    printer = Printer(
        np.dtype(np.float64), {"g": f"{prefix}_estimate_t", "s": f"{prefix}_t"}, real_type="double"
    )
    functions = []
    if est is not None:
        constant = ("T_s", "omega_b", "X_f", "forget", "settled")
        grid = Struct(
            {
                name: est[name] if name in constant else place(name, (), f"g->{name}")
                for name in est.dtype.names or ()
            }
        )
        arguments = [grid, *(Expr("var", (name,)) for name in "pwV")]
        functions.append(translate.function(estimate, arguments))
    functions.append(translate.function(choose, [scheduled, now, at, *ends]))
    return "\n".join(printer.function(one) for one in functions)
