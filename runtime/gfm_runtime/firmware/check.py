"""Builds a firmware folder for a target, runs it, compares every bit with the kernel's; proves it.

A target is a compiler and, for a bare processor, a machine of QEMU (system emulation, semihosting).
Under ``-icount`` QEMU's clock counts instructions, so their number is the same in every run.
"""

import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from gfm_runtime.errors import LawError
from gfm_runtime.firmware.golden import CHECKED, golden
from gfm_runtime.firmware.module import Module
from gfm_runtime.firmware.report import read_report

HARNESS = files("gfm_runtime.firmware").joinpath("harness")
PROGRAM = "program.elf"
#: also what CMakeLists.txt gives; sqrt is one instruction without errno
FLAGS = ("-std=c99", "-ffp-contract=off", "-fno-math-errno")
OPTIMISED = "-O2"
_SHIFT = 10  # one instruction takes 2^10 ns of QEMU's time: many ticks of the board's timer
_QEMU = (
    "-display", "none", "-monitor", "none", "-serial", "none",
    "-semihosting-config", "enable=on,target=native",
    "-icount", f"shift={_SHIFT},align=off,sleep=off",
)  # fmt: skip
_TIMEOUT_S = 300


@dataclass(frozen=True)
class Target:
    """A compiler and where its programs run."""

    what: str  #: in words
    prefix: str = ""  #: of the compiler and its tools
    compiler: str = "gcc"  #: the compiler's name after the prefix
    packages: str = ""  #: from apt, for the compiler and the machine
    flags: tuple[str, ...] = ()  #: for the processor
    link: tuple[str, ...] = ("-lm",)  #: for the linker
    machine: tuple[str, ...] = ()  #: QEMU's command, or () for this machine
    #: of the clock that counts instructions; 0 for QEMU in user mode, which has none
    tick_ns: int = 0
    optimised: str = OPTIMISED  #: flag for the compiler
    real: str = "float64"  #: float32 if that is all that its floating-point unit has
    order: Literal["<", ">"] = "<"  #: of bytes, as numpy has it

    @property
    def run(self) -> list[str]:
        """The command that runs ``PROGRAM``."""
        system = (*_QEMU, "-kernel") if self.tick_ns else ()
        return [*self.machine, *system, f"./{PROGRAM}"]

    def instructions(self, ticks: int) -> int:
        """How many instructions so many ticks of the clock are."""
        return round(ticks * self.tick_ns / 2**_SHIFT)


_ARM: dict[str, Any] = {
    "prefix": "arm-none-eabi-",
    "packages": "gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm",
    "link": ("-nostartfiles", "-T", str(HARNESS.joinpath("arm.ld")), "-lm"),
    "tick_ns": 40,
}
#: of a program for Linux on another processor, which QEMU's user mode runs
_LINUX: dict[str, Any] = {"link": ("-static", "-lm")}
TARGETS = {
    "host": Target("this machine, gcc", packages="gcc libc6-dev"),
    "clang": Target("this machine, clang", compiler="clang", packages="clang libc6-dev"),
    "m4f": Target(
        "Cortex-M4F in QEMU", **_ARM, real="float32",
        optimised="-Os",  # takes 3 to 7 % fewer instructions than -O2
        flags=("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"),
        machine=("qemu-system-arm", "-machine", "mps2-an386"),
    ),
    "m7": Target(
        "Cortex-M7 in QEMU", **_ARM,
        flags=("-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard"),
        machine=("qemu-system-arm", "-machine", "mps2-an500"),
    ),
    "m3": Target(
        "Cortex-M3, floats in software, in QEMU", **_ARM, real="float32",
        flags=("-mcpu=cortex-m3", "-mthumb", "-mfloat-abi=soft"),
        machine=("qemu-system-arm", "-machine", "mps2-an385"),
    ),
    "rv64": Target(
        "RISC-V rv64gc in QEMU", "riscv64-unknown-elf-", tick_ns=1,
        packages="gcc-riscv64-unknown-elf picolibc-riscv64-unknown-elf qemu-system-misc",
        flags=("-march=rv64gc", "-mabi=lp64d", "-mcmodel=medany", "--specs=picolibc.specs"),
        link=("-nostartfiles", "-T", str(HARNESS.joinpath("riscv.ld")), "-lm"),
        machine=("qemu-system-riscv64", "-machine", "virt", "-bios", "none"),
    ),
    "s390x": Target(
        "s390x, big-endian, in QEMU", "s390x-linux-gnu-", **_LINUX, machine=("qemu-s390x",),
        packages="gcc-s390x-linux-gnu libc6-dev-s390x-cross qemu-user",
        flags=("-fexcess-precision=fast",), order=">",
    ),
    "aarch64": Target(
        "aarch64 in QEMU", "aarch64-linux-gnu-", **_LINUX, machine=("qemu-aarch64",),
        packages="gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user",
    ),
    "i386": Target(
        "i386 with SSE2 in QEMU", "i686-linux-gnu-", **_LINUX, machine=("qemu-i386",),
        packages="gcc-i686-linux-gnu libc6-dev-i386-cross qemu-user",
        flags=("-msse2", "-mfpmath=sse"),
    ),
}  # fmt: skip


@dataclass(frozen=True)
class CheckResult:
    """What a law gave on a target."""

    name: str  #: the law
    rows: int  #: golden rows that it was stepped through
    differ: int  #: words of outputs and state, over all rows, that are not the kernel's
    #: fewest and most of a step, or None where they are not counted
    instructions: tuple[int, int] | None
    checks: int | None  #: instructions of these that check whether y and ref are in range, or None
    #: code, constants: bytes of the law's object file
    code: int
    constants: int
    state: int  #: bytes of one instance
    stack: int | None  #: bytes that a step needs at most, or None where the compiler does not say

    @property
    def law_and_limits(self) -> tuple[int, int]:
        """Fewest and most instructions of a step without the checks of its inputs. Raises
        ValueError: the target counts no instructions."""
        if self.instructions is None or self.checks is None:
            raise ValueError(f"{self.name}: no instructions were counted")
        least, most = self.instructions
        return least - self.checks, most - self.checks


def check(
    folder: Path, target: str, flags: str | None = None, ticks: int = CHECKED
) -> list[CheckResult]:
    """Build, run and compare a folder that ``export`` wrote. Raises LawError: no such folder, a
    missing tool (the apt package is named), a build that fails, or a program that does not end as
    it should.

    Args:
        folder: with report.json and the sources.
        target: one of ``TARGETS``.
        flags: more for the compiler, e.g. ``"-O3"``, in place of the target's ``optimised``.
        ticks: golden rows of each law.
    """
    found, where = read_report(folder), need_tools(target)
    names = [m.prefix for m in found.modules]
    names += ["gfm"] * (found.style == "records")
    for file in (folder / f"{name}.c" for name in (*names, "selftest")):
        if not file.is_file():
            raise LawError(str(file), "is not there; gfmhil firmware export writes it")
    rows = golden(found.modules, ticks)
    with tempfile.TemporaryDirectory(prefix="gfmhil-firmware-") as work:
        at = Path(work)
        (at / "golden.bin").write_bytes(
            rows.words.astype(rows.words.dtype.newbyteorder(where.order)).tobytes()
        )
        rest = [folder.resolve() / "selftest.c", Path(str(HARNESS.joinpath("harness.c")))]
        hooks = ["-DGOLDEN_NO_MAIN", "-DGOLDEN_CLOCK=clock_now"]
        build(folder.resolve(), at, where, names, [*hooks, *map(str, rest)], flags)
        said = run_tool(where.run, at)
        out = []
        for k, m in enumerate(found.modules):
            line = re.search(rf"^law {k} (\d+) (\d+) (\d+) (\d+) (\d+) (\d+)$", said, re.MULTILINE)
            if line is None:
                raise LawError(f"target {target}", f"the program said no result of {m.name}")
            counted, differ, least, most, checks, state = map(int, line.groups())
            clocked, of_checks = None, None
            if where.tick_ns:
                clocked = where.instructions(least), where.instructions(most)
                of_checks = where.instructions(checks)
            step = "gfm" if found.style == "records" else m.prefix
            code, constants = _sections(at, where, {step, m.prefix})
            stack = _stack(at / f"{step}.su", f"{step}_step")
            sizes = code, constants, state, stack
            out.append(CheckResult(m.name, counted, differ, clocked, of_checks, *sizes))
        return out


def need_tools(target: str) -> Target:
    """A target of ``TARGETS`` whose compiler and machine are there. Raises LawError: they are not
    (the apt packages are named)."""
    where = TARGETS[target]
    for tool in (where.prefix + where.compiler, where.prefix + "size", *where.machine[:1]):
        if shutil.which(tool) is None:
            raise LawError(
                f"target {target}", f"{tool} is not there; apt-get install {where.packages}"
            )
    return where


def build(
    folder: Path,
    at: Path,
    where: Target,
    names: Sequence[str],
    rest: Sequence[str],
    flags: str | None = None,
) -> None:
    """Compile the modules ``names`` of a folder, and a program around them, to ``PROGRAM``. Raises
    LawError: it does not compile.

    Args:
        folder: has the modules' sources.
        at: where the objects and the program go.
        where: the target.
        names: of the modules, without an end.
        rest: the program's sources, and more for their compiler.
        flags: more for the compiler, in place of the target's ``optimised``.
    """
    compiler = [where.prefix + where.compiler, *FLAGS, *where.flags]
    compiler += shlex.split(where.optimised if flags is None else flags)
    own = [str(folder / f"{name}.c") for name in names]
    run_tool([*compiler, "-fstack-usage", f"-I{folder}", "-c", *own], at)
    run_tool([*compiler, "-std=gnu99", f"-I{folder}", "-c", *rest], at)
    sources = [*names, *(Path(text).stem for text in rest if text.endswith(".c"))]
    run_tool([*compiler, *(f"{name}.o" for name in sources), "-o", PROGRAM, *where.link], at)


def run_tool(command: Sequence[str], at: Path) -> str:
    """Run a program in a folder; what it says. Raises LawError: it fails, or takes too long."""
    try:
        done = subprocess.run(
            command, cwd=at, capture_output=True, text=True, check=False, timeout=_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise LawError(command[0], f"has not ended after {_TIMEOUT_S} s") from None
    said = done.stdout + done.stderr
    if done.returncode:
        lines = said.splitlines()
        errors = [x for x in lines if "error" in x or "undefined" in x] or lines
        code = done.returncode
        ended = f"code {code}" if code > 0 else f"ended by {signal.Signals(-code).name}"
        raise LawError(command[0], f"failed: {next(iter(errors), ended)}")
    return said


def _sections(at: Path, where: Target, names: set[str]) -> tuple[int, int]:
    """Bytes of code and of constants of object files."""
    said = run_tool([where.prefix + "size", "-A", *(f"{name}.o" for name in sorted(names))], at)
    code = constants = 0
    for section, size in re.findall(r"^(\.\S+)\s+(\d+)\s", said, re.MULTILINE):
        if section.startswith(".text"):
            code += int(size)
        elif section.startswith((".rodata", ".srodata")):
            constants += int(size)
    return code, constants


def _stack(usage: Path, step: str) -> int | None:
    """Bytes of stack: those of the step and of all functions of the file that are not public."""
    if not usage.exists():
        return None
    prefix, total = step.removesuffix("step"), 0
    for line in usage.read_text(encoding="utf-8").splitlines():
        place, size, _ = line.split("\t")
        function = place.rsplit(":", 1)[-1]
        if function == step or not function.startswith(prefix):
            total += int(size)
    return total


# --- the proof by EVA of Frama-C that a folder in fixed point has no overflow or stray access ---

EVA = "eva"
FRAMA_C, PACKAGE = "frama-c", "frama-c-base"
#: int and pointers of 32 bits, as on a Cortex-M; an alarm also where a conversion loses bits
OPTIONS = ("-eva", "-eva-slevel", "20", "-eva-auto-loop-unroll", "32", "-eva-split-return", "auto",
           "-warn-signed-downcast", "-machdep", "gcc_x86_32", "-cpp-extra-args=-I.")  # fmt: skip


@dataclass(frozen=True)
class ProofResult:
    """What EVA says of a law."""

    name: str  #: the law
    alarms: int  #: what it could not prove
    functions: int  #: how many it went through: all of the law and of the harness
    seconds: float  #: what it took


def _files_of(module: Module) -> tuple[str, str]:
    """The harness and the source of a law, in its folder."""
    return f"proof/{module.prefix}.c", f"{module.prefix}.c"


def script(modules: Sequence[Module]) -> str:
    """proof/prove.sh: the same without gfmhil."""
    command = " ".join((FRAMA_C, *OPTIONS))
    lines = (f"{command} {' '.join(_files_of(m))} || exit\n" for m in modules)
    return (
        f"#!/bin/sh\n# apt-get install {PACKAGE}; each summary must end with 0 alarms.\n"
        f'cd "$(dirname "$0")/.." || exit\n{"".join(lines)}'
    )


def prove(folder: Path) -> list[ProofResult]:
    """Run EVA on each law of a folder that ``export`` wrote in fixed point.

    It follows all values that variables can have, through an endless loop of calls in any order
    with any int32 as inputs: with 0 alarms no run of the code has undefined behaviour, and no
    conversion loses bits. Raises LawError: no such folder, a folder in a floating-point precision,
    no Frama-C (the apt package is named), or an analysis that does not go through all of the code.
    """
    found = read_report(folder)
    if not all(m.fixed for m in found.modules):
        raise LawError(f"target {EVA}", f"{folder} has {found.real}; it proves --real fixed only")
    if shutil.which(FRAMA_C) is None:
        raise LawError(f"target {EVA}", f"{FRAMA_C} is not there; apt-get install {PACKAGE}")
    out = []
    for m in found.modules:
        start = time.monotonic()
        # by whole paths: Frama-C takes its own folder from PWD, which may be another one
        sources = [str(folder.resolve() / name) for name in _files_of(m)]
        said = run_tool([FRAMA_C, *OPTIONS, *sources], folder)
        alarms = re.search(r"(\d+) alarms? generated by the analysis", said)
        reached = re.search(r"(\d+) functions analyzed \(out of (\d+)\)", said)
        if alarms is None or reached is None or reached[1] != reached[2]:
            raise LawError(f"target {EVA}", f"Frama-C did not go through all of {m.name}")
        took = time.monotonic() - start
        out.append(ProofResult(m.name, int(alarms[1]), int(reached[1]), round(took, 1)))
    return out
