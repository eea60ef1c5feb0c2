"""report.json and report.md of a firmware folder: what was exported, and what a step costs.

report.json also holds each law's record as hexadecimal numbers. ``read_report`` makes the record
anew from them, so that ``gfmhil firmware check`` needs no law file.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gfm_runtime.counts import COUNTS_CONSTANTS, COUNTS_STATE
from gfm_runtime.error_maps import DVOC
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import literal
from gfm_runtime.firmware.fixed import FIXED, G_MOST, NEAR, FixedLaw, deviations, make_fixed
from gfm_runtime.firmware.module import REALS, STYLES, Module, Style, check_modules, fields, tunable
from gfm_runtime.firmware.tick import SHARED, SIZE, Tick
from gfm_runtime.inner import INNER_CONSTANTS
from gfm_runtime.kernel import law_dtype
from gfm_runtime.lawfile import LawFile
from gfm_runtime.regular import read_regular
from gfm_runtime.signals import NU, NY, U_NAMES, carried_rows, group, table_hash

FORMAT = 1  # of report.json
_MOST_BYTES = 64 << 20
_MOST_S = max(abs(s.low) for s in group("y") if s.name in ("p", "q"))
#: what stands beside a bound for dvoc
DEAD_BUS = (
    f"dvoc: p/V^2 and q/V^2 saturate at {G_MOST:g} p.u. in fixed point, so with |p| or |q| of "
    f"{_MOST_S:g} p.u. below V = {math.sqrt(_MOST_S / G_MOST):.2f} p.u.; float64 goes on. "
    "Its bound is to the law with that saturation."
)
_FAR = (
    "How far u gets from float64 at most, for all inputs in range, p.u.; t is the time in s since "
    "the start or the last settle. The state of an integrator drifts in open loop, in any "
    "precision; a loop that is closed holds it. Small signals are within "
    f"{NEAR:g} p.u. of the default inputs."
)


class FirmwareFolder(NamedTuple):
    """What a firmware folder holds."""

    modules: list[Module]
    real: str
    style: Style


def reports(modules: Sequence[Module], T_s: float, style: Style) -> dict[str, str]:
    """report.json and report.md."""
    fixed = modules[0].fixed is not None
    rows = fixed or style == "tunable"
    laws = [
        {
            "name": m.name,
            "prefix": m.prefix,
            "title": m.law.title if m.law else "",
            "source": " ".join(m.law.source.split()) if m.law else "",
            "states": m.n,
            "bytes": sizes(m, style),
            "operations": operations(m, style),
            "record": {
                n: _hex(m.record[n]) for part in fields(m.stages, rows, m.counts) for n in part
            },
            **({"file": m.tuning.file.model_dump(exclude_unset=True)} if m.tuning else {}),
            **({"deviation": _deviations(m.fixed, m.record, T_s)} if m.fixed else {}),
        }
        for m in modules
    ]
    real, stages = modules[0].precision, modules[0].stages
    whole = {"format": FORMAT, "signal_table": table_hash(), "stages": stages,
             "counts": modules[0].counts, "T_s": T_s,
             "real": real, "style": style, "laws": laws}  # fmt: skip
    return {
        "report.json": json.dumps(whole, indent=1, ensure_ascii=False) + "\n",
        "report.md": _page(laws, T_s, real, style),
    }


def read_report(folder: Path) -> FirmwareFolder:
    """What ``report.json`` of a folder says. Raises LawError: there is none, or it is not of this
    format."""
    path = folder / "report.json"
    try:
        text = read_regular(path, _MOST_BYTES).decode("utf-8")
    except FileNotFoundError:
        raise LawError(str(path), "is not there; gfmhil firmware export writes it") from None
    except OSError as problem:
        raise LawError(str(path), f"cannot be read: {problem.strerror}") from None
    except UnicodeDecodeError:
        raise LawError(str(path), "is not a text in UTF-8") from None
    try:
        whole = json.loads(text)
    except (ValueError, RecursionError) as problem:
        raise LawError(str(path), f"is not JSON: {problem}") from None
    try:
        return _parse(whole)
    except LawError as problem:
        raise problem.within(str(path)) from None
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        lacks = f" ({problem} is missing)" if isinstance(problem, KeyError) else ""
        why = f"is not as gfmhil firmware export writes it{lacks}; export the folder again"
        raise LawError(str(path), why) from None


@np.errstate(over="ignore")  # what overflows is refused
def _parse(whole: Any) -> FirmwareFolder:
    for key, allowed in (("format", (FORMAT,)), ("real", (*REALS, FIXED)), ("style", STYLES)):
        if whole[key] not in allowed:
            raise LawError(key, f"{whole[key]!r} must be {' or '.join(map(str, allowed))}")
    fixed = whole["real"] == FIXED
    dtype = law_dtype("float64" if fixed else whole["real"])
    stages, counts = (bool(whole.get(key)) and not fixed for key in ("stages", "counts"))
    named = fields(stages, fixed or whole["style"] == "tunable", counts)
    modules = [
        Module(str(law["name"]), None, _record(law["record"], dtype, named), stages, counts)
        for law in whole["laws"]
    ]
    if not modules:
        raise LawError("laws", "there must be one")
    check_modules(modules)
    if whole["style"] == "tunable":
        files = [LawFile(**law["file"]) for law in whole["laws"]]
        T_s = float(whole["T_s"])
        modules = [tunable(m, file, T_s) for m, file in zip(modules, files, strict=True)]
    if fixed:
        modules = [replace(m, fixed=make_fixed(m.name, m.record)) for m in modules]
    return FirmwareFolder(modules, whole["real"], whole["style"])


def _hex(value: Any) -> str | int | list[int]:
    """Numbers of a precision, in their order, between blanks; or an integer, or a list of them."""
    if value.dtype.kind == "i":
        return value.tolist()
    return " ".join(literal(v, value.dtype).rstrip("f") for v in np.ravel(value))


def _record(
    given: Mapping[str, Any], dtype: np.dtype[Any], named: tuple[tuple[str, ...], ...]
) -> np.void:
    out = np.zeros(1, dtype)
    integers, numbers_of = named
    for name in (*integers, *numbers_of):
        text, shape = given[name], dtype[name].shape
        try:
            if name in integers:
                out[0][name] = text
            else:
                out[0][name] = np.reshape([float.fromhex(word) for word in text.split()], shape)
        except (TypeError, ValueError, OverflowError, AttributeError):
            kind = "integer" if name in integers else "hexadecimal number"
            wanted = f"{math.prod(shape)} {kind}{'s' * (math.prod(shape) > 1)}"
            raise LawError(f"record.{name}", f"must be {wanted}; export the folder again") from None
    return out[0]


def sizes(m: Module, style: Style) -> dict[str, int]:
    """Bytes of one instance's numbers, and of a law's constants in a step.

    A compiler may keep a constant in its code, or once for several uses; ``gfmhil firmware check``
    measures what came of it.
    """
    state = max(1, m.n) + 3 * NU + SIZE * m.stages
    state += sum(size for _, size, _ in COUNTS_STATE) * m.counts
    if m.fixed:
        rests = 2 * NU + m.n
        constants = 4 * operations(m, style)["multiplications"]
        return {"state": 4 * state + 8 * rests, "constants": constants}
    if style == "records":
        n, of = m.n, 2 * NY + NU
        constants = 2 + n * n + n * (of + of + NU) + NU * (n + 3 * NY + 3) + 3
        constants += (len(INNER_CONSTANTS) - len(SHARED)) * m.stages
        constants += sum(COUNTS_CONSTANTS.values()) * m.counts
    else:
        constants = m.tick.constants()
    if m.tuning:
        state += 2 * len(m.tuning.first)
    return {"state": state * m.real.itemsize, "constants": constants * m.real.itemsize}


def operations(m: Module, style: Style) -> dict[str, int]:
    """Operations of a step in which all limits clamp, the refusal included; without shifts."""
    generic = style == "records"  # it has the zeros too
    tick = Tick(m.record, m.real, max(1, m.n), m.stages, True, m.counts) if generic else m.tick
    count = m.fixed_tick.operations() if m.fixed else tick.operations()
    carried = (*carried_rows("y", m.stages), *group("ref"))
    ranges = sum(1 if s.low == -s.high and not m.fixed else 2 for s in carried)
    finite = 0 if m.fixed else 2 * (NU + m.stages) - 1  # whether u is
    return {
        "multiplications": count["*"],
        "additions": count["+"] + count["-"] + count["rounded"] + finite,
        "divisions": count["/"],
        "square_roots": count["sqrt"] + count["root"],
        "comparisons": count["<"] + 2 * count["between"] + ranges + 1,
    }


def _deviations(law: FixedLaw, record: np.void, T_s: float) -> dict[str, list[dict[str, Any]]]:
    """Of each output, p.u. and p.u./s; None where there is no bound. Float64's own is included."""
    out = {}
    for name, real, near in (("fixed", FIXED, False), ("fixed, small signals", FIXED, True),
                             ("float32", "float32", False)):  # fmt: skip
        found, exact = (deviations(law, record, which, near) for which in (real, "float64"))
        out[name] = [
            {"bound": _finite(d.bound + e.bound), "drift": _finite((d.drift + e.drift) / T_s)}
            for d, e in zip(found, exact, strict=True)
        ]
    return out


def _finite(value: float) -> float | None:
    """Rounded up to two digits; None for no bound."""
    if not math.isfinite(value) or value == 0.0:
        return None if value else 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit) * unit:.2g}")


def deviation_text(found: Mapping[str, float | None]) -> str:
    """A bound as report.json has it: p.u., and t in s; a dash for none."""
    if found["bound"] is None:
        return "–"
    return f"{found['bound']:.1e}" + (f" + {found['drift']:.0e} t" if found["drift"] else "")


def _table(heads: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = ["| " + " | ".join(map(str, cells)) + " |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|---" * len(heads) + "|", *lines[1:]])


def _page(laws: Sequence[Mapping[str, Any]], T_s: float, real: str, style: str) -> str:
    heads = ("law", "states", "bytes of state", "bytes of constants", "×", "+ −", "÷", "√",
             "comparisons")  # fmt: skip
    costs = _table(heads, (
        (law["name"], law["states"], *law["bytes"].values(), *law["operations"].values())
        for law in laws
    ))  # fmt: skip
    deviation = ""
    bits = (
        "Bits: compile without `-ffast-math` and with `-ffp-contract=off`; `selftest.c` compares "
        "every output and state with `golden.h`, bit by bit."
    )
    if real == FIXED:
        bounds = _table(("law", "precision", *U_NAMES), (
            (law["name"], kind, *map(deviation_text, law["deviation"][kind]))
            for law in laws
            for kind in laws[0]["deviation"]
        ))  # fmt: skip
        dead = any(law["record"]["error_map"] == DVOC for law in laws)
        deviation = f"{_FAR}\n\n{bounds}\n\n" + f"{DEAD_BUS}\n\n" * dead
        bits = (
            "Bits: `selftest.c` compares every output and state with `golden.h`, bit by bit. "
            "`proof/prove.sh` proves with Frama-C that nothing overflows."
        )
    return f"""\
# Firmware of gfmhil

{len(laws)} law{"s" * (len(laws) > 1)} as C99, {real}, style {style}, T_s = {T_s:g} s, \
signal table {table_hash()}.

{costs}

The operations are those of one step in which every limit clamps. `gfmhil firmware check` counts \
instructions, code and stack on a target.

{deviation}{bits}
"""
