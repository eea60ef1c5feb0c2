"""The folder that ``gfmhil firmware export`` writes: sources, golden vectors, self-test, report."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib.metadata import version
from xml.sax.saxutils import escape

from gfm_runtime.catalogue import LawSet
from gfm_runtime.counts import COUNTS_STATE
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import plain, render
from gfm_runtime.firmware.check import script
from gfm_runtime.firmware.fixed import FIXED
from gfm_runtime.firmware.golden import SHIPPED, Golden, columns, golden
from gfm_runtime.firmware.module import C_TYPES, MADE, Module, Style, make_modules, sources, tunable
from gfm_runtime.firmware.report import reports
from gfm_runtime.firmware.schedule import schedule_sources, stage_names
from gfm_runtime.firmware.tick import SIZE
from gfm_runtime.law import BuiltLaw
from gfm_runtime.lawfile import LawFile
from gfm_runtime.signals import COUNTS, N_ADC, NU, carried
from gfm_runtime.states import BAD_U

_PROVE = """
# cmake --build build --target proof
add_custom_target(proof COMMAND sh ${CMAKE_CURRENT_SOURCE_DIR}/proof/prove.sh)
"""
#: by file, its template
_BUILD_FILES = {
    "CMakeLists.txt": "CMakeLists.txt",
    "zephyr/module.yml": "zephyr.yml",
    "zephyr/Kconfig": "Kconfig",
    "zephyr/CMakeLists.txt": "zephyr.cmake",
    "gfmhil.gfm.pdsc": "gfmhil.gfm.pdsc",
}


def export(
    laws: Mapping[str, BuiltLaw],
    T_s: float,
    real: str,
    style: Style,
    omega_b: float = 100 * math.pi,
    scheduled: Iterable[LawSet] = (),
    files: Mapping[str, LawFile] | None = None,
) -> dict[str, str]:
    """The files of a firmware folder by name. Raises LawError: as ``make_modules``, and what fixed
    point does not cover.

    Args:
        laws: the laws by name; a change between any two of them is bumpless.
        T_s: sampling time, s.
        real: float32 or float64, or ``FIXED``, which has one style only.
        style: see ``gfm_runtime.firmware.module``.
        omega_b: base frequency of the converter, rad/s, for an inner stage.
        files: of the laws, for style ``tunable``.
        scheduled: laws whose stages, under the names of ``stage_names``, are among ``laws``.
    """
    fixed = real == FIXED
    if fixed and style != "unrolled":
        raise LawError(
            f"--style {style}", "fixed point has its constants in the code; leave it out"
        )
    for one in scheduled if fixed or style == "tunable" else ():
        what = "fixed point" if fixed else "--style tunable"
        raise LawError(
            f"law {one.name!r}",
            f"is scheduled, which {what} does not cover; export its stages as laws",
        )
    modules = make_modules(laws, T_s, real, omega_b)
    if style == "tunable":
        modules = [tunable(m, (files or {})[m.name], T_s) for m in modules]
    by_name = {m.name: m for m in modules}
    choosing: dict[str, str] = {}
    for one in scheduled:
        own = [by_name[name] for name in stage_names(one)]
        choosing |= schedule_sources(one, own, T_s, omega_b, style)
    rows = golden(modules, SHIPPED)
    built = _build_files(modules, style, choosing)
    built["CMakeLists.txt"] += _PROVE * fixed
    return {
        **sources(modules, T_s, style),
        **choosing,
        **selftest(modules, style),
        "golden.h": _golden_header(rows),
        "golden.csv": rows.csv(),
        **({"proof/prove.sh": script(modules)} if fixed else {}),
        **built,
        **reports(modules, T_s, style),
    }


def selftest(modules: Sequence[Module], style: Style) -> dict[str, str]:
    """selftest.h and selftest.c."""
    adapters, table, own = [], [], style != "records"
    parts: tuple[str, ...] = ("init", "reset", "step", "look", "settle", "change", "view", "spoil")
    tuned = modules[0].tuning is not None
    parts += ("tune",) * tuned
    parts += ("go_on", "align", "calibrate") * modules[0].counts
    stages = modules[0].stages
    precision, fixed = modules[0].precision, modules[0].fixed is not None
    counts = modules[0].counts
    choices = {"stages": stages, "fixed": fixed, "counts": counts, "tuned": tuned}
    e = {"E": ", const golden_real *e" * stages, "e": ", e" * stages, "NOW_E": ", now.e" * stages}
    for m in modules:
        keys = {
            "P": m.prefix,
            "T": m.prefix if own else "gfm",
            "ARGUMENT": "" if own else f"&{m.prefix}_law, ",
            "N": str(m.n),
            "REST": str(2 * NU + m.n),
            "SETS": ",\n        ".join(map(m.tuning.initialiser, m.sets())) if m.tuning else "",
            **e,
        }
        adapters.append(render("adapter.c", keys, choices))
        table.append("    {" + ", ".join(f"{m.prefix}_do_{part}" for part in parts) + "},")
    states = max([1, *(m.n for m in modules)])
    keys = {
        "MADE": MADE,
        **C_TYPES[precision],
        "LAWS": str(len(modules)),
        "NX": str(states),
        "NY": str(N_ADC if counts else len(carried("y", stages))),
        "NU": str(len(carried("u", COUNTS if counts else stages))),
        "N_COUNTS": str(sum(size for _, size, _ in COUNTS_STATE)),
        "SENSED": str(
            columns(0, True, counts=True).index("sensed_0")
            - columns(0, True, counts=True).index("angle_0")
        ),
        "STAGE": str(SIZE),
        "MEASURED": "sensed" if counts else "y",
        "E_AT": str(columns(0, True).index("e_d") - columns(0, True).index("i_ref_d")),
        "BAD_U": str(BAD_U),
        "WORDS": str(len(columns(states, stages, fixed, counts))),
        **e,
        "LAW_INCLUDES": "\n".join(f'#include "{m.prefix}.h"' for m in modules),
        "ADAPTERS": "".join(adapters).rstrip("\n") + "\n",
        "TABLE": "\n".join(table),
        "NAMES": "\n".join(f'    "{m.prefix}",' for m in modules),
        "SIZES": "\n".join(f"    sizeof({m.prefix if own else 'gfm'}_t)," for m in modules),
    }
    return {name: render(name, keys, choices) for name in ("selftest.h", "selftest.c")}


def _golden_header(rows: Golden) -> str:
    bits = 8 * rows.words.itemsize
    suffix = "U" if bits == 32 else "ULL"
    lines = (
        "    {" + ",".join(f"0x{w:x}{suffix}" for w in row) + "},\n" for row in rows.words.tolist()
    )
    return f"""\
/* {MADE} Words of a row: {", ".join(rows.columns)}. */
#ifndef GFM_GOLDEN_H
#define GFM_GOLDEN_H

#include <stdint.h>

enum {{ GOLDEN_ROWS = {len(rows.words)} }};

static const uint{bits}_t golden[][{len(rows.columns)}] = {{
{"".join(lines)}}};

#endif
"""


def _build_files(
    modules: Sequence[Module], style: Style, choosing: Collection[str]
) -> dict[str, str]:
    """For CMake and ESP-IDF, for Zephyr, and a description as a CMSIS pack."""
    names = [f"{m.prefix}.c" for m in modules] + ["gfm.c"] * (style == "records")
    names += [file for file in choosing if file.endswith(".c")]
    headers = [f"{name.removesuffix('.c')}.h" for name in names]
    root = bool(choosing) or style != "unrolled"  # whether the code takes a square root
    root = root or any(not m.fixed and (m.stages or m.tick.operations()["sqrt"]) for m in modules)
    kinds = [("header", name) for name in headers] + [("source", name) for name in names]
    keys = {
        "MADE": MADE,
        "VERSION": version("gfmhil"),
        "SOURCES": " ".join(names),
        "HEADERS": " ".join(headers),
        "ZEPHYR_SOURCES": " ".join(f"../{name}" for name in names),
        "FILES": "\n".join(f'        <file category="{k}" name="{n}" />' for k, n in kinds),
        "LIBM": "target_link_libraries(gfm PUBLIC m)\n" if root else "",
        "LAWS": escape(", ".join(plain(m.name) for m in modules)),
    }
    return {file: render(template, keys) for file, template in _BUILD_FILES.items()}
