"""The C modules of a set of laws: one header and one source for each, in one of three styles.

* ``unrolled``: each law is a module of its own with its constants in the code.
* ``tunable``: as ``unrolled``, but what follows from the law's gains is in RAM, and a function
  makes it from new gains while the law runs.
* ``records``: each law is a constant record (``gfm_<law>_law``) for the generic step of
  ``gfm.h`` and ``gfm.c``. A calibration tool may write such a record in RAM.
"""

import hashlib
import itertools
import json
import math
import textwrap
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from gfm_runtime.counts import COUNTS_CONSTANTS, COUNTS_NUMBERS, COUNTS_STATE
from gfm_runtime.error_maps import ERROR_MAPS, HYBRID_ANGLE, LINEAR
from gfm_runtime.errors import LawError
from gfm_runtime.firmware.c_text import Choices, identifier, literal, literals, plain, render
from gfm_runtime.firmware.fixed import FIXED, REFS, U_DEFAULT, YS, FixedLaw, make_fixed
from gfm_runtime.firmware.tick import SHARED, FixedTick, Tick
from gfm_runtime.firmware.tuning import GainChanges
from gfm_runtime.inner import INNER_CONSTANTS, INNER_STATE, KINDS, NONE, PRIORITIES
from gfm_runtime.inner_file import acting
from gfm_runtime.kernel import N_MAX, pack_law
from gfm_runtime.law import BuiltLaw
from gfm_runtime.lawfile import LawFile
from gfm_runtime.signals import (
    INNER,
    N_LEGS,
    NU,
    NY,
    TABLE_VERSION,
    Y_I_D,
    Y_OMEGA,
    Y_P,
    Y_Q,
    Y_V,
    Y_V_DC,
    Signal,
    carried_rows,
    command_rows,
    group,
    table_hash,
)
from gfm_runtime.states import BAD_SENSOR, BAD_U, BAD_Y, OK, REASONS
from gfm_runtime.tustin import discretise

MADE = "Made by gfmhil firmware export; do not edit."

Style = Literal["unrolled", "tunable", "records"]
STYLES: tuple[Style, ...] = get_args(Style)
REALS = ("float32", "float64")

#: what a step returns; the bench's scenario refuses a reference out of range before it gets here
BAD_REF = len(REASONS)
RESULTS = {
    "OK": (OK, "runs"),
    "BAD_Y": (BAD_Y, REASONS[BAD_Y]),
    "BAD_U": (BAD_U, REASONS[BAD_U]),
    "BAD_SENSOR": (BAD_SENSOR, REASONS[BAD_SENSOR]),
    "BAD_REF": (BAD_REF, "a reference is not finite or out of range"),
}
RESULT_TEXT = "0, or why the bridge must be blocked: " + "; ".join(
    f"{code} {text}" for code, text in RESULTS.values() if code
)
#: by precision, what the templates say of the C type
C_TYPES = {
    "float32": {"C_REAL": "float", "BITS": "32", "DIG": "FLT_MANT_DIG", "MANTISSA": "24"},
    "float64": {"C_REAL": "double", "BITS": "64", "DIG": "DBL_MANT_DIG", "MANTISSA": "53"},
    FIXED: {"C_REAL": "int32_t", "BITS": "32"},
}
#: fields of a law's record that are integers, and those in its precision
INTEGERS = ("n", "error_map")
NUMBERS = (
    "error_parameters", "A", "B_r", "B_y", "C", "D_r", "D_y", "D_u0", "u_0", "loop", "low", "high",
    "W", "decay", "follow", "E_r", "E_y", "F", "G",
)  # fmt: skip
#: of the inner stage, in a folder with a law that has one
STAGE_INTEGERS = ("inner", "priority", "freeze", "row")


#: of measurement and modulation, in a folder whose laws have them
COUNTS_INTEGERS = tuple(name for name, _ in COUNTS_NUMBERS if name != "counts")


def fields(
    stages: bool, rows: bool = False, counts: bool = False
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The fields of a law's record that are integers, and those in its precision; ``rows``: also
    without a stage the row of u that each state belongs to."""
    if not stages:
        return (*INTEGERS, *["row"] * rows), NUMBERS
    integers, numbers = INTEGERS + STAGE_INTEGERS, NUMBERS + INNER_CONSTANTS
    if counts:
        return integers + COUNTS_INTEGERS, numbers + tuple(COUNTS_CONSTANTS)
    return integers, numbers


@dataclass(frozen=True)
class Module:
    """A law on its way to C."""

    name: str  #: the law's name, with its stage if it has several
    law: BuiltLaw | None  #: the law itself; None for one that was read back from a report
    record: np.void  #: the law as ``pack_law`` gives it
    #: whether a law of its folder has an inner stage: y has 11 signals then, and u 4
    stages: bool = False
    counts: bool = False  #: whether the laws of its folder measure and modulate
    fixed: FixedLaw | None = None  #: the law in fixed point; None in a floating-point precision
    tuning: GainChanges | None = None  #: how its gains change while it runs, in style tunable

    @property
    def prefix(self) -> str:
        """What the names of its module begin with, e.g. ``gfm_vsg_1``."""
        return f"gfm_{identifier(self.name)}"

    def identification(self, T_s: float) -> str:
        """What stands in its code, in ASCII: which gfmhil made it, of which law, with which numbers
        (the first half of a SHA-256), for which T_s, s, and nominal frequency, Hz."""
        names = itertools.chain(*fields(self.stages, self.fixed is not None, self.counts))
        numbers = b"".join(self.record[name].tobytes() for name in names)
        f_n = float(self.record["half_turn"]) / (math.pi * T_s)
        return (
            f"gfmhil {version('gfmhil')}; {plain(self.name)}; "
            f"{hashlib.sha256(numbers).hexdigest()[:32]}; {self.precision}; "
            f"T_s = {T_s:g} s; f_n = {f_n:.6g} Hz"
        )

    @property
    def inputs(self) -> tuple[Signal, ...]:
        """What a step takes beside the references: y, or counts of the A/D."""
        return group("adc") if self.counts else carried_rows("y", self.stages)

    @property
    def outputs(self) -> tuple[Signal, ...]:
        """What it gives: u, and compare counts after it."""
        return (*command_rows(self.stages), *(group("compare") if self.counts else ()))

    @property
    def n(self) -> int:
        """States of the law."""
        return int(self.record["n"])

    @property
    def choices(self) -> Choices:
        """The choices of the templates for its unrolled step."""
        code, fixed = int(self.record["error_map"]), self.fixed is not None
        return {
            "stages": self.stages,
            "counts": self.counts,
            "fixed": fixed,
            "tuned": self.tuning is not None,
            "own": not fixed,
            "mapped": code != LINEAR,
            "angle": code == HYBRID_ANGLE,
            "states": self.n > 0,
        }

    @cached_property
    def tick(self) -> Tick:
        """The functions of its step in floating point."""
        tuned = self.tuning.fields() if self.tuning else None
        n = max(1, self.n)
        return Tick(self.record, self.real, n, self.stages, counts=self.counts, tuned=tuned)

    @cached_property
    def fixed_tick(self) -> FixedTick:
        """The functions of its step in fixed point."""
        assert self.fixed is not None
        return FixedTick(self.fixed)

    def sets(self) -> list[dict[str, float]]:
        """The gains of its golden rows."""
        return self.tuning.sets(zlib.crc32(self.prefix.encode())) if self.tuning else []

    @property
    def real(self) -> np.dtype[Any]:
        """float32 or float64; of a law in fixed point that of its record."""
        return np.dtype(self.record["u_0"].dtype)

    @property
    def precision(self) -> str:
        """One of ``REALS``, or ``FIXED``."""
        return FIXED if self.fixed else str(self.real)


def make_modules(
    laws: Mapping[str, BuiltLaw], T_s: float, real: DTypeLike, omega_b: float = 100 * math.pi
) -> list[Module]:
    """The laws by name, discretised at T_s [s] and packed in float32 or float64, or in fixed point.
    Raises LawError: a law that does not discretise, or that fixed point does not cover, and as
    ``check_modules``.

    Args:
        laws: if one has an inner stage, all are made for y and u with its signals.
        T_s: sampling time, s.
        real: float32 or float64, or ``FIXED``.
        omega_b: base frequency of the converter, rad/s, for the inner stage.
    """
    if real == FIXED:
        for name, law in laws.items():
            if law.inner is not None:
                why = "has an inner stage, which fixed point has not; use float32 or --inner none"
                raise LawError(f"law {name!r}", why)
            if law.counts is not None:
                why = "measures and modulates, which fixed point does not; use float32"
                raise LawError(f"law {name!r}", why)
        plain_ones = make_modules(laws, T_s, np.float64, omega_b)
        return [replace(m, fixed=make_fixed(m.name, m.record)) for m in plain_ones]
    counts = any(law.counts is not None for law in laws.values())
    for name, law in laws.items():
        if counts and law.counts is None:
            why = "has no [measure] and [modulate], which others have; give --counts"
            raise LawError(f"law {name!r}", why)
    stages = counts or any(law.inner is not None for law in laws.values())
    modules = [
        Module(name, law, pack_law(discretise(law, T_s), real, omega_b)[0], stages, counts)
        for name, law in laws.items()
    ]
    check_modules(modules)
    return modules


def tunable(module: Module, file: LawFile, T_s: float) -> Module:
    """The module with gains that can change while it runs. Raises LawError: as ``GainChanges``.

    Args:
        file: of the module's law, whose own parameters have the values in force.
        T_s: sampling time, s.
    """
    if module.law is not None:
        file = file.model_copy(update={"parameters": dict(module.law.parameters)})
    return replace(module, tuning=GainChanges(file, module.record, T_s))


def check_modules(modules: Sequence[Module]) -> None:
    """Refuse what C cannot hold. Raises LawError: a number of states, an error map or a stage that
    the kernel does not know, a constant that is not finite, a name without a letter, or two names
    that are the same in C."""
    taken: dict[str, str] = {}
    for module in modules:
        where = f"law {module.name!r}"
        if not 0 <= module.n <= N_MAX:
            raise LawError(where, f"{module.n} states must be 0 to {N_MAX}")
        if int(module.record["error_map"]) not in ERROR_MAPS.values():
            raise LawError(where, f"error map {module.record['error_map']} is not known")
        possible = {"inner": KINDS.values(), "priority": PRIORITIES.values(), "one": (1.0,)}
        for field, allowed in possible.items() if module.stages else ():
            if module.record[field] not in allowed:
                raise LawError(where, f"{field} = {module.record[field]} is not possible")
        if module.stages and module.record["inner"] != NONE and not module.record["k_c"] > 0:
            raise LawError(where, f"k_c = {module.record['k_c']} is not possible")
        for field in fields(module.stages, counts=module.counts)[1]:
            if not np.isfinite(module.record[field]).all():
                raise LawError(where, f"{field} must be finite in {module.real}")
        if module.prefix == "gfm_":
            raise LawError(where, "its name has no letter or digit for C")
        if module.prefix in taken:
            raise LawError(where, f"{taken[module.prefix]!r} has the same name in C")
        taken[module.prefix] = module.name


def sources(modules: Sequence[Module], T_s: float, style: Style) -> dict[str, str]:
    """The headers and sources by file name."""
    if style != "records":
        out, proofs = dict[str, str](), dict[str, str]()
        for m in modules:
            tick = m.fixed_tick if m.fixed else m.tick
            keys = keys_of(m) | {"LAW": "", "law": ""}
            keys["TYPES"], keys["IDENTIFICATION"] = _identification_in_c(m, T_s)
            if m.tuning:
                keys |= m.tuning.keys(m.prefix)
            if m.counts:
                rows, which = carried_rows("y", INNER), not_bounded(m.record)
                keys["PIN_CHECKS"] = _checks("y", rows, _literals(rows, m.real), which)
            text = render("interface.h", keys, m.choices)
            out[f"{m.prefix}.h"] = about(m, T_s) + "\n" + text.replace("\n\n\n", "\n")
            out[f"{m.prefix}.c"] = _shell(keys | tick.keys(m.prefix), m.choices)
            if m.fixed:
                keys["HINTS"] = m.fixed_tick.hints()
                proofs[f"proof/{m.prefix}.c"] = render("proof.c", keys)
        return out | proofs
    states = max([1, *(m.n for m in modules)])
    real, stages = modules[0].real, modules[0].stages
    choices = {**modules[0].choices, "own": False, "tuned": False}
    counts = modules[0].counts
    common = _keys("gfm", real, states, stages, counts) | {
        "LAW": "const gfm_law_t *law, ",
        "law": "law, ",
    }
    names = [name for name in INNER_CONSTANTS if name not in SHARED]
    if counts:
        names += [f"{name}[{n}]" if n > 1 else name for name, n in COUNTS_CONSTANTS.items()]
    common["IDENTIFICATION"] = ""
    types = common | {
        "COUNTS_INTEGERS": ", ".join(COUNTS_INTEGERS),
        "KINDS": "; ".join(
            ", ".join(f"{code} {name}" for name, code in codes.items())
            for codes in (KINDS, PRIORITIES)
        ),
        "CONSTANTS": "\n        ".join(textwrap.wrap(", ".join(names), 80)),
    }
    common["TYPES"] = render("records.h", types, choices).rstrip("\n")
    generic = Tick(None, real, states, stages, counts=counts)
    out = {
        "gfm.h": f"/* The generic step of a law. {MADE} */\n"
        + render("interface.h", common, choices),
        "gfm.c": _shell(common | generic.keys("gfm"), choices),
    }
    for m in modules:
        guard = f"{m.prefix.upper()}_H"
        out[f"{m.prefix}.h"] = (
            f"{about(m, T_s)}\n#ifndef {guard}\n#define {guard}\n\n"
            f'#include "gfm.h"\n\nextern const gfm_law_t {m.prefix}_law;\n'
            f"{_identification_in_c(m, T_s)[0]}\n\n#endif\n"
        )
        out[f"{m.prefix}.c"] = (
            f'#include "{m.prefix}.h"\n\nconst gfm_law_t {m.prefix}_law = {_record(m, states)};\n'
            f"{_identification_in_c(m, T_s)[1]}"
        )
    return out


def _identification_in_c(m: Module, T_s: float) -> tuple[str, str]:
    """Its identification in C: the declaration and the definition."""
    text = m.identification(T_s)
    name = f"const char {m.prefix}_id[{len(text) + 1}]"
    about = "/* What this code is; a tool compares it. Refer to it, or a linker may drop it. */"
    return f"{about}\nextern {name};", f"\n{name} =\n    {json.dumps(text)};\n"


def _shell(keys: Mapping[str, str], choices: Choices) -> str:
    """The source of a module; with the whole interrupt if its law measures and modulates."""
    text = render("shell.c", keys, choices)
    return text + (render("isr.c", keys, choices) if choices["counts"] else "")


def about(m: Module, T_s: float) -> str:
    """The comment at the top: the law, its source, its parameters with units and sources."""
    lines = [f"{m.name}. {MADE}", ""]
    if m.law is not None:
        lines[0] = f"{m.name}: {m.law.title}. {MADE}"
        lines += [f"Source: {m.law.source}", f"Errors: {m.law.error_map}. Parameters:"]
        lines += [
            f"  {name} = {p.value:g} {p.unit} {f'({p.source})' * bool(p.source)}".rstrip()
            for name, p in m.law.parameters.items()
        ]
        lines += [
            f"Limits of (i_u, omega_u, E_u): {m.law.limits.low} to {m.law.limits.high} p.u.; "
            f"anti-windup T_t = {m.law.limits.T_t:g} s, bumpless change T_off = "
            f"{m.law.limits.T_off:g} s"
        ]
        if m.law.inner is not None:
            f_n = float(m.record["half_turn"]) / (math.pi * T_s)
            numbers = ", ".join(f"{name} = {value}" for name, value in acting(m.law.inner).items())
            lines += [f"Inner stage at f_n = {f_n:g} Hz: {m.law.inner.kind}, {numbers}"]
    lines += [
        f"Discretised by Tustin; call step every T_s = {T_s:g} s. {m.n} states, {m.precision}."
    ]
    if m.fixed:
        lines += ["Integers only: every compiler gives the same bits."]
    else:
        lines += [
            "Constants are hexadecimal, exact to the bit: 0x1.8p+1 is 1.5 * 2^1, which is 3.",
            "Compile with -ffp-contract=off: a fused multiply-add gives other bits.",
        ]
    out: list[str] = []
    for line in lines:
        indent = line[: len(line) - len(line.lstrip())]
        out += textwrap.wrap(plain(line), 96, initial_indent=indent,
                             subsequent_indent=indent + "    ") or [""]  # fmt: skip
    return "/* " + "\n".join(f" * {line}".rstrip() for line in out)[3:] + "\n */"


def _variables(prefix: str, members: Sequence[tuple[str, int, str]]) -> str:
    """Members of a structure in the law's precision: name, size, what it is."""
    return "\n".join(
        f"    {prefix}_real {name}{f'[{size}]' * (size > 1)};{f' /* {text} */' * bool(text)}"
        for name, size, text in members
    )


def _keys(
    prefix: str, real: np.dtype[Any], n: int, stages: bool, counts: bool = False
) -> dict[str, str]:
    """What the templates of a module ask for."""
    y, u, ref = carried_rows("y", stages), command_rows(stages), group("ref")
    guard = prefix.upper()
    rows = []
    pins = (("ADC", group("adc")), ("CMP", group("compare"))) if counts else ()
    for letter, signals in (("REF", ref), ("Y", y), ("U", u), *pins):
        members = [
            f"    {guard}_{letter}_{s.name.upper().removeprefix(f'{letter}_')}, "
            f"/* {s.description}, {s.unit} of {s.base}, "
            f"{s.low:g} to {s.high:g} */"
            for s in signals
        ]
        rows += ["enum {", *members, f"    {guard}_N{letter}", "};", ""]
    phi = (f"{guard}_NROWS", f"{guard}_NCOLUMNS") if stages else (f"{guard}_NU", f"{guard}_NY")
    of_phi = f", {phi[0]} = {NU}, {phi[1]} = {NY}" * stages
    rows.append(f"enum {{ {guard}_NX = {max(1, n)}{of_phi} }};")
    where = f"/* The order of ref, y and u: gfmhil's signal table, version {TABLE_VERSION}"
    return {
        "P": prefix,
        "GUARD": guard,
        **C_TYPES[str(real)],
        "GUARDS": render("guards.c", {"P": prefix, **C_TYPES[str(real)]}).rstrip("\n"),
        "SIGNALS": "\n".join([f"{where} ({table_hash()}). */", *rows]),
        "REASONS": "\n".join(
            f"    {guard}_{name} = {code}{',' * (name != 'BAD_REF')} /* {text} */"
            for name, (code, text) in RESULTS.items()
        ),
        "Y_CHECKS": _checks("y", y, _literals(y, real)),
        "PIN_CHECKS": _checks("y", y, _literals(y, real)),
        "REF_CHECKS": _checks("ref", ref, _literals(ref, real)),
        "U_DEFAULT": literals([s.default for s in group("u")], real),
        "U_LOW": ", ".join(repr(s.low) for s in u),
        "U_HIGH": ", ".join(repr(s.high) for s in u),
        "OMEGA_DEFAULT": literal(u[1].default, real),
        "N": str(n),
        "N_ROWS": phi[0],
        "N_COLUMNS": phi[1],
        "STAGE": _variables(prefix, INNER_STATE),
        "COUNTS": _variables(prefix, COUNTS_STATE),
        "AT_REST": literals(at_rest(), real),
        "E": ", const real e[]" * stages,
        "e": ", e" * stages,
        "E_OF": f", const {prefix}_real e[]" * stages,
        # MISRA C:2012, 10.3 and 10.4, asks for constants of that type
        "0": "0.0f" if real == np.float32 else "0.0",
        "1": "1.0f" if real == np.float32 else "1.0",
    }


def at_rest() -> list[float]:
    """y (11,) with which a law that measures begins: by default, along the voltage."""
    V = next(s.default for s in group("y") if s.name == "V")
    return [s.default + V * (s.name == "v_d") for s in carried_rows("y", INNER)]


def keys_of(m: Module) -> dict[str, str]:
    """What the templates of an unrolled or tunable law ask for."""
    keys = _keys(m.prefix, m.real, m.n, m.stages, m.counts) | {
        "MADE": MADE,
        "LAW_NAME": plain(m.name),
    }
    if m.fixed:
        formats = "\n".join(m.fixed_tick.formats(m.prefix.upper()))
        keys |= {
            **C_TYPES[FIXED],
            "SIGNALS": f"{keys['SIGNALS']}\n{formats}",
            "Y_CHECKS": _checks("y", group("y"), [(one.low, one.high) for one in YS]),
            "REF_CHECKS": _checks("ref", group("ref"), [(one.low, one.high) for one in REFS]),
            "U_DEFAULT": ", ".join(map(str, U_DEFAULT)),
            "0": "0",
        }
    return keys


def not_bounded(law: np.void) -> list[int]:
    """Places in y that may be out of range for some counts of the A/D, p and q always among them.

    The vector of three phases is longest at a corner of what they read.
    """
    zero, scale = np.float64(law["adc_zero"]), np.float64(law["adc_scale"])
    ends = np.array([-zero * scale, (law["adc_top"] - zero) * scale])
    axes = np.exp(2j * np.pi / 3 * np.arange(N_LEGS)) / 1.5
    out = {Y_P, Y_Q}
    longest = list[float]()
    for k in range(3):
        corners = np.array(list(itertools.product(*ends[:, 1 + 3 * k : 4 + 3 * k].T)))
        if law["two"] and k != 1:
            corners[:, 2] = -corners[:, 0] - corners[:, 1]
        longest.append(float(1.001 * np.abs(corners @ axes).max()))
    ranges = {
        Y_V_DC: (min(ends[:, 0]), max(ends[:, 0])),
        Y_V: (0.0, longest[1]),
        Y_OMEGA: (law["low"][1], law["high"][1]),
        **{Y_I_D + j: (-longest[j // 2], longest[j // 2]) for j in range(6)},
    }
    for j, s in enumerate(carried_rows("y", INNER)):
        low, high = ranges.get(j, (0.0, 0.0))
        if not (s.low <= low and high <= s.high):
            out.add(j)
    return sorted(out)


def _literals(signals: Sequence[Signal], real: np.dtype[Any]) -> list[tuple[str, str]]:
    """The ends of their ranges in C."""
    return [(literal(s.low, real), literal(s.high, real)) for s in signals]


def _checks(
    vector: str,
    signals: Sequence[Signal],
    ends: Sequence[tuple[Any, Any]],
    which: Sequence[int] | None = None,
) -> str:
    """An expression up to its last colon: the first signal that is NaN or out of range; of those
    in the places ``which``, or of all."""
    lines = []
    for j, (s, (low, high)) in enumerate(zip(signals, ends, strict=True)):
        if which is not None and j not in which:
            continue
        value = f"{vector}[{j}]"
        inside = f"{value} >= {low} && {value} <= {high}"
        if isinstance(high, str) and s.low == -s.high:
            inside = f"{'fabsf' if high.endswith('f') else 'fabs'}({value}) <= {high}"
        lines.append(f"!({inside}) ? {j} /* {s.name}, {s.low:g} to {s.high:g} p.u. */")
    return "\n             : ".join(lines)


def _record(m: Module, states: int) -> str:
    """A law's record as an initialiser, for a generic step with room for ``states``."""
    integers, numbers = fields(m.stages, counts=m.counts)
    room: dict[str, tuple[int, ...]] = {"A": (states, states), "C": (NU, states)}
    room |= dict.fromkeys(("B_r", "B_y", "W", "E_r", "E_y", "F", "G", "row"), (states,))
    lines = ["{"]
    for field in (*integers, *numbers):
        if field in SHARED:
            continue
        value = (
            m.record[field][tuple(map(slice, room[field]))] if field in room else m.record[field]
        )
        text = _initialiser(value, m.real)
        if field in integers:
            text = "{" + ", ".join(map(str, value)) + "}" if field == "row" else str(int(value))
        lines.append(f"    .{field} = {text},")
    return "\n".join([*lines, "}"])


def _initialiser(value: NDArray[Any], real: np.dtype[Any]) -> str:
    if value.ndim == 0:
        return literal(value, real)
    if value.ndim == 1:
        return "{" + literals(value, real) + "}"
    return "{\n        " + ",\n        ".join(_initialiser(row, real) for row in value) + "}"
