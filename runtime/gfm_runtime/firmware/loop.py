"""The program of a processor in the loop: the laws of a run as one program for a target.

It waits for a tick's references and measurements in a pipe, steps the law, and answers in another
pipe what the law gives and what a run records of it. All words have the size of the law's numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gfm_runtime.counts import COUNTS_STATE
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.check import HARNESS, Target, build, need_tools
from gfm_runtime.firmware.folder import selftest
from gfm_runtime.firmware.module import Module, check_modules, sources
from gfm_runtime.firmware.tick import SIZE
from gfm_runtime.inner import INNER_STATE
from gfm_runtime.kernel import N_MAX
from gfm_runtime.signals import COUNTS, N_ADC, NU, NY, NY_INNER, carried

#: what a request asks for before its tick: nothing, a change to its law, that its frame be aligned;
#: or to start at a state, to step through a golden row, or to say what a law's code is
TICK, START, CHANGE, CHECK, ALIGN, IDENTIFY = range(6)
#: the pipes in the program's folder, by which it gets requests and gives answers
TO, FROM = "to", "from"


@dataclass(frozen=True)
class LoopProgram:
    """A program, built."""

    target: Target  #: where it runs
    folder: Path  #: where it lies, and in which its pipes have to be
    #: request, state, answer: of what goes over the pipes; a state follows each START, a golden row
    #: each CHECK
    request: np.dtype[Any]
    state: np.dtype[Any]
    answer: np.dtype[Any]
    identification: np.dtype[Any]  #: what follows the answer to IDENTIFY: text, then zeros
    identifications: tuple[str, ...]  #: of the laws


def build_loop(
    modules: Sequence[Module], T_s: float, target: str, folder: Path, firmware: Path | None = None
) -> LoopProgram:
    """Build the program of a target for a run's laws; law k of a request is ``modules[k]``. Raises
    LawError: laws without counts for a firmware, a law that C cannot hold, a missing tool (the apt
    packages are named), or a build that fails.

    Args:
        modules: all with y and u of the same signals, in one precision.
        T_s: sampling time, s.
        target: one of ``gfm_runtime.firmware.TARGETS``.
        folder: empty.
        firmware: with C sources that have the functions of ``loop.h``, in place of the bare laws.
    """
    where = need_tools(target)
    check_modules(modules)
    expected = tuple(m.identification(T_s) for m in modules)
    real, stages = modules[0].real, modules[0].stages
    texts = {**sources(modules, T_s, "unrolled"), **selftest(modules, "unrolled")}
    for name, text in (texts | {"states.h": _states(modules, max(map(len, expected)) + 1)}).items():
        (folder / name).write_text(text, encoding="utf-8")
    program = [str(HARNESS.joinpath("loop.c"))]
    if firmware is not None:
        if not modules[0].counts:
            raise LawError("counts", f"missing; the interrupt of {firmware} begins with them")
        own = {
            file
            for m in modules
            for end in "ch"
            if (file := firmware / f"{m.prefix}.{end}").is_file()
        }
        for file in own:  # a firmware may bring the code of its laws
            (folder / file.name).write_bytes(file.read_bytes())
        program += [str(file.absolute()) for file in sorted(set(firmware.glob("*.c")) - own)]
        program += ["-DLOOP_FIRMWARE", f"-I{HARNESS}", f"-I{firmware.absolute()}"]
    build(folder, folder, where, [m.prefix for m in modules], program)
    real, word = (
        dtype.newbyteorder(where.order) for dtype in (real, np.dtype(f"i{real.itemsize}"))
    )
    counts = modules[0].counts
    y = N_ADC if counts else len(carried("y", stages))
    u = len(carried("u", COUNTS if counts else stages))
    request: list[Any] = [("what", word), ("law", word), ("limited", word), ("ref", real, (NY,))]
    answer: list[Any] = [("result", word), ("channel", word), ("limited", word), ("count", word)]
    state: list[Any] = [
        ("x", real, (N_MAX,)),
        *((name, real, (NU,)) for name in ("offset", "u", "trend")),
    ]
    answer += [("u", real, (u,)), ("own", real, (NU,)), ("bump", real), ("i_ref", real, (2,))]
    state += [(name, real, (size,)) for name, size, _ in INNER_STATE if stages]
    kept = [(name, real, (size,) if size > 1 else ()) for name, size, _ in COUNTS_STATE if counts]
    request += [("y", real, (y,)), *[("measured", real, (NY_INNER,))] * counts]
    dtypes = [np.dtype(fields) for fields in (request, state + kept, answer + kept)]
    own_text = np.dtype(f"S{max(map(len, expected)) + 1}")
    return LoopProgram(where, folder, dtypes[0], dtypes[1], dtypes[2], own_text, expected)


def _states(modules: Sequence[Module], size: int) -> str:
    """states.h: what loads a whole state into an instance of a law, its channel, and what it is;
    that is cut at ``size`` bytes."""
    stages = modules[0].stages
    parts = {"x": 0, "offset": N_MAX, "u": N_MAX + NU, "trend": N_MAX + 2 * NU}
    end = N_MAX + 3 * NU
    if stages:
        parts, end = parts | {"stage": end}, end + SIZE
    if modules[0].counts:
        parts, end = parts | {"counts": end}, end + sum(size for _, size, _ in COUNTS_STATE)
    lines = [
        f"enum {{ STATE_REALS = {end}, ID_SIZE = {size} }};",
        f"#define STAGES {int(stages)}",
        f"#define COUNTS {int(modules[0].counts)}",
        f"#define NOW_E {', now.e' * stages}",
    ]
    for m in modules:
        copies = "".join(
            f"    memcpy(&s->{part}, from + {at}, sizeof s->{part});\n"
            for part, at in parts.items()
        )
        lines.append(f"""\
static void {m.prefix}_load(int k, const golden_real *from, int limited)
{{
    {m.prefix}_t *s = &{m.prefix}_of[k];
{copies}    {"s->limited = limited" if stages else "(void)limited"};
}}
static int {m.prefix}_channel(int k)
{{
    return {m.prefix}_of[k].channel;
}}
static void *{m.prefix}_at(int k)
{{
    return &{m.prefix}_of[k];
}}""")
    lines += ["static const struct {",
              "    void (*load)(int k, const golden_real *from, int limited);",
              "    int (*channel)(int k);",
              "    void *(*at)(int k);",
              "    const char *id;",
              "    unsigned long id_size;",
              "} states[] = {"]  # fmt: skip
    lines += [
        f"    {{{m.prefix}_load, {m.prefix}_channel, {m.prefix}_at, {m.prefix}_id, "
        f"sizeof {m.prefix}_id}},"
        for m in modules
    ]
    return "\n".join([*lines, "};", ""])
