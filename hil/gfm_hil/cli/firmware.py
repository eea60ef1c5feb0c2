"""gfmhil firmware: laws as C99, their golden vectors, and the check on a processor."""

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path

from rich.markup import escape

from gfm_hil.api.law import write_files
from gfm_hil.cli.common import EXIT_OTHERWISE, add_counts, add_inner, print_result
from gfm_hil.controllers.compile_model import compile_model
from gfm_hil.controllers.dll import describe_model
from gfm_hil.core.errors import UserError, need
from gfm_hil.core.files import replacing, write_or_print, write_text
from gfm_hil.core.terminal import terminal
from gfm_hil.results.table import Table
from gfm_runtime import BuiltLaw, LawSet, firmware, law_file, law_names, load_law
from gfm_runtime.firmware import CHECKED, EVA, FIXED, FMI, REALS, SHIPPED, STYLES, TARGETS

ALL = "all"
_SHOWN = 8  # files of laws that export names one by one
_MOST = 1_000_000  # golden rows of a law, which fill some hundred megabytes


def add(command: argparse.ArgumentParser) -> None:
    kinds = command.add_subparsers(dest="kind", required=True, metavar="KIND")
    out = kinds.add_parser("export", help="write laws as C99, with golden vectors and a self-test")
    _add_laws(out)
    out.add_argument(
        "--style", choices=STYLES, default=STYLES[0],
        help="unrolled: constants in the code (default); tunable: gains in RAM, changed by a call; "
        "records: a generic step for records",
    )  # fmt: skip
    out.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="the folder")
    out.set_defaults(call=call_export)
    dll = kinds.add_parser(
        "dll", help="build a law as a real-code model of the IEEE/CIGRE interface, for EMT programs"
    )
    dll.add_argument("law", metavar="LAW", help="a name, or a .toml file")
    _add_how(dll)
    dll.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="the folder")
    dll.set_defaults(call=call_dll)
    own = kinds.add_parser(
        "compile", help="compile a real-code model's own C source for Linux, and list its ports"
    )
    own.add_argument(
        "sources", type=Path, nargs="+", metavar="SOURCE", help="C files, and folders of them"
    )
    own.add_argument(
        "-I", dest="include", type=Path, action="append", default=[], metavar="DIR",
        help="a folder of headers; may be repeated",
    )  # fmt: skip
    own.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the .so")
    own.set_defaults(call=call_compile)
    unit = kinds.add_parser("fmu", help="build a law as an FMU for co-simulation")
    unit.add_argument("law", metavar="LAW", help="a name, or a .toml file")
    _add_how(unit)
    unit.add_argument("--fmi", choices=FMI, default=FMI[-1], help=f"version of FMI ({FMI[-1]})")
    unit.add_argument(
        "--xcp", action="store_true",
        help="with the A2L file of its memory, by the layered standard FMI-LS-XCP",
    )  # fmt: skip
    unit.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the .fmu")
    unit.set_defaults(call=call_fmu)
    a2l = kinds.add_parser("a2l", help="write the calibration file (A2L) of a firmware's ELF file")
    a2l.add_argument("elf", type=Path, metavar="ELF", help="linked, with debug information (-g)")
    a2l.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the .a2l")
    a2l.set_defaults(call=call_a2l)
    vectors = kinds.add_parser("golden", help="write golden vectors of laws as CSV")
    _add_laws(vectors)
    vectors.add_argument(
        "--ticks", type=int, default=SHIPPED, metavar="N", help=f"rows of each law ({SHIPPED})"
    )
    vectors.add_argument("-o", "--out", type=Path, metavar="FILE", help="else to the screen")
    vectors.set_defaults(call=call_golden)
    include = kinds.add_parser(
        "include",
        help="print the folder of gfmhil_controller.h and gfmhil_frames.h, for your own C code",
    )
    include.set_defaults(call=call_include)
    proof = kinds.add_parser("check", help="build and run a folder, and compare every bit")
    proof.add_argument("folder", type=Path, metavar="DIR", help="what export wrote")
    proof.add_argument(
        "--target", choices=[*TARGETS, EVA], default="host",
        help="; ".join(f"{name}: {target.what}" for name, target in TARGETS.items())
        + f"; {EVA}: no run, but Frama-C's proof that --real fixed never overflows",
    )  # fmt: skip
    others = ", ".join(
        f"{target.optimised} on {name}"
        for name, target in TARGETS.items()
        if target.optimised != firmware.OPTIMISED
    )
    proof.add_argument("--flags", help=f"for the compiler ({firmware.OPTIMISED}, {others})")
    proof.add_argument(
        "--ticks", type=int, default=CHECKED, metavar="N", help=f"rows of each law ({CHECKED})"
    )
    proof.add_argument("--json", action="store_true", help="the result as JSON")
    proof.set_defaults(call=call_check)


def _add_laws(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "laws", nargs="+", metavar="LAW", help=f"names, .toml files, or {ALL}: every law that ships"
    )
    _add_how(command, (*REALS, FIXED))


def _add_how(command: argparse.ArgumentParser, reals: Sequence[str] = REALS) -> None:
    command.add_argument("--real", choices=reals, default=reals[0], help="precision (float32)")
    command.add_argument(
        "--T_s", type=float, default=1e-4, metavar="S", help="sampling time, s (1e-4)"
    )
    add_inner(command)
    add_counts(command)
    command.add_argument(
        "--f_n", type=float, default=50.0, metavar="HZ",
        help="nominal frequency of the converter, for an inner stage (50)",
    )  # fmt: skip


def call_export(options: argparse.Namespace) -> int:
    sets = _sets(options)
    scheduled = [one for one in sets if one.schedule is not None]
    which = "fixed point" if options.real == FIXED else "--style tunable"
    if ALL in options.laws and scheduled and (options.real == FIXED or options.style == "tunable"):
        sets = [one for one in sets if one.schedule is None]
        names = ", ".join(one.name for one in scheduled)
        print(f"gfmhil: {names}: left out, since {which} does not cover schedules", file=sys.stderr)
        scheduled = []
    laws, omega_b, own = _laws(sets), _omega_b(options.f_n), None
    if options.style == "tunable":
        own = {file.name: file for file in map(law_file, _names(options.laws))}
    files = firmware.export(laws, options.T_s, options.real, options.style, omega_b, scheduled, own)
    write_files(options.out, files)
    modules = [name for name in files if Path(name).name.startswith("gfm_")]
    shown = [f"{len(modules)} files gfm_*"] if len(modules) > _SHOWN else modules
    print(f"{options.out}: {', '.join([*shown, *(n for n in files if n not in modules)])}")
    stale = sorted({path.name for path in options.out.glob("gfm_*.[ch]")} - set(files))
    if stale:
        print(
            f"gfmhil: {options.out} also holds {', '.join(stale)} of an earlier export",
            file=sys.stderr,
        )
    return 0


def call_dll(options: argparse.Namespace) -> int:
    law = load_law(options.law, options.inner, options.counts)
    files = firmware.dll_sources(law, options.T_s, options.real, _omega_b(options.f_n))
    write_files(options.out, files)
    print(firmware.build_dll(options.out, law.name, files))
    return 0


def call_compile(options: argparse.Namespace) -> int:
    used = compile_model(options.sources, options.include, options.out)
    told, rows = describe_model(options.out)
    print(f"{options.out}: {', '.join(x.name for x in used)}", told, sep="\n")
    heads = ("in a map", "width, default", "unit", "description")
    terminal().print(Table(heads, rows, text=None), highlight=False)
    return 0


def call_fmu(options: argparse.Namespace) -> int:
    law = load_law(options.law, options.inner, options.counts)
    omega_b = _omega_b(options.f_n)
    if options.xcp:
        need("elftools", "pyelftools", "firmware fmu --xcp", "calibration")
    packed = firmware.fmu(law, options.T_s, options.real, options.fmi, omega_b, options.xcp)
    with replacing(options.out) as part:
        part.write_bytes(packed)
    print(options.out)
    return 0


def call_a2l(options: argparse.Namespace) -> int:
    need("elftools", "pyelftools", "firmware a2l", "calibration")
    text, measured, calibrated = firmware.elf_a2l(options.elf)
    write_text(options.out, text)
    print(f"{options.out}: {measured} measurements, {calibrated} characteristics")
    if not calibrated:
        print(
            "gfmhil: the gains are constants in the code; a law of --style records whose record "
            "lies in RAM can be calibrated",
            file=sys.stderr,
        )
    return 0


def call_golden(options: argparse.Namespace) -> int:
    laws, omega_b = _laws(_sets(options)), _omega_b(options.f_n)
    modules = firmware.make_modules(laws, options.T_s, options.real, omega_b)
    write_or_print(options.out, firmware.golden(modules, _ticks(options.ticks)).csv())
    return 0


def call_include(_: argparse.Namespace) -> int:
    print(files("gfm_hil.controllers"))
    return 0


def call_check(options: argparse.Namespace) -> int:
    """Check a folder and print a table; 3 if a bit differs, or Frama-C has an alarm."""
    if options.target == EVA:
        proofs = firmware.prove(options.folder)
        rows = [(p.name, p.functions, p.alarms, f"{p.seconds:g}") for p in proofs]
        table = Table(("law", "functions", "alarms", "seconds"), rows)
        print_result(options, [asdict(proof) for proof in proofs], [table])
        return EXIT_OTHERWISE if any(proof.alarms for proof in proofs) else 0
    results = firmware.check(options.folder, options.target, options.flags, _ticks(options.ticks))
    flags = TARGETS[options.target].optimised if options.flags is None else options.flags
    differ = sum(result.differ for result in results)
    words = f"words that differ: {differ}" if differ else "no word differs"
    said = escape(f"{options.target}, {flags}: {words}")
    print_result(options, [asdict(result) for result in results], [_table(results), said])
    if differ and not options.json:
        print(
            "gfmhil: words differ from the kernel's: look for a fused multiply-add, sums in a "
            "wider type, numbers flushed to zero, or a changed source",
            file=sys.stderr,
        )
    return EXIT_OTHERWISE if differ else 0


def _names(given: Sequence[str]) -> list[str]:
    """The names of laws, with those of all that ship in place of ``ALL``."""
    return [name for one in given for name in (law_names() if one == ALL else [one])]


def _sets(options: argparse.Namespace) -> list[LawSet]:
    """The laws that are named, with an inner stage, and measurement and modulation, in place of
    their own."""
    return [load_law(name, options.inner, options.counts) for name in _names(options.laws)]


def _laws(sets: Sequence[LawSet]) -> dict[str, BuiltLaw]:
    """Laws by name; a scheduled law in its stages. Raises UserError: two have one name."""
    laws: dict[str, BuiltLaw] = {}
    for found in sets:
        for label, law in zip(firmware.stage_names(found), found.laws, strict=True):
            if label in laws:
                raise UserError(f"law {label!r}: is named twice")
            laws[label] = law
    return laws


def _omega_b(f_n: float) -> float:
    if not (math.isfinite(f_n) and f_n > 0.0):
        raise UserError(f"--f_n {f_n:g}: must be > 0 Hz")
    return 2 * math.pi * f_n


def _ticks(ticks: int) -> int:
    if not 1 <= ticks <= _MOST:
        raise UserError(f"--ticks {ticks}: must lie in [1, {_MOST}]")
    return ticks


def _table(results: Sequence[firmware.CheckResult]) -> Table:
    heads = ("law", "rows", "words that differ", "instructions", "of these checks", "code [B]",
             "constants [B]", "state [B]", "stack [B]")  # fmt: skip
    rows = [
        (
            r.name, r.rows, r.differ,
            None if r.instructions is None else f"{r.instructions[0]}…{r.instructions[1]}",
            r.checks, r.code, r.constants, r.state, r.stack,
        )
        for r in results
    ]  # fmt: skip
    about = "constants: read-only data; state: one instance; report.md counts the law's numbers"
    return Table(heads, rows, caption=about)
