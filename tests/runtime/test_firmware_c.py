"""Firmware compiled: every bit of every law on this machine and on processors in QEMU."""

import ctypes
import re
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_runtime import LawError, get_law, load_law
from gfm_runtime.firmware import CHECKED, FIXED, REALS, STYLES, TARGETS, check, golden, make_modules
from gfm_runtime.kernel import state_dtype, step
from gfm_runtime.states import BAD_U, BAD_Y, OK

from ..support import firmware
from ..support.firmware import FEW_STAGED, MOST, SOME, STAGED, T_S, cc, exported
from ..support.laws import LAWS, REF, wander

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]

PAGES = Path(__file__).parents[2] / "docs"
FUSES = pytest.mark.skipif(
    " fma " not in Path("/proc/cpuinfo").read_text(), reason="the processor has no FMA"
)
RISC_V = pytest.mark.skipif(
    not all(map(shutil.which, ("riscv64-unknown-elf-gcc", "qemu-system-riscv64"))),
    reason="no RISC-V toolchain; it takes a gigabyte, so CI goes without",
)
STRICT = [*firmware.STRICT, "-Wdouble-promotion", "-ffp-contract=off"]


#: the laws without and with an inner stage; ``FEW`` has those whose code differs most
KINDS = {"plain": LAWS, "staged": STAGED}
FEW = {"plain": SOME, "staged": FEW_STAGED}
Folder = Callable[..., Path]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    """A folder with all laws of a kind, or few, of a precision and style; made once."""

    @cache
    def made(kind: str, real: str, style: str, few: bool = False) -> Path:
        at, names = tmp_path_factory.mktemp(f"{kind}-{style}-{real}"), FEW[kind] if few else ()
        return exported(at, real, style, *names, of=KINDS[kind])

    return made


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("target", "real", "style", "flags", "whole"),
    [
        ("host", "float32", "unrolled", "-O0", ()), ("host", "float32", "unrolled", "-O3", ()),
        ("host", "float64", "records", "-O3", KINDS),
        ("clang", "float64", "unrolled", "-O2", KINDS),
        ("m4f", "float32", "unrolled", None, "plain"), ("m4f", "float32", "records", None, ()),
        ("m7", "float64", "unrolled", None, "plain"),
        pytest.param("rv64", "float64", "unrolled", None, "plain", marks=RISC_V),
    ],
)  # fmt: skip
def test_every_law_has_the_kernels_bits(folder, kind, target, real, style, flags, whole):
    """All laws of the kinds in ``whole``; of the others few, with every statement of all. On
    processors in QEMU plain laws also take the instructions of the page's table."""
    few = kind not in whole
    found = check(folder(kind, real, style, few), target, flags)
    names = (FEW if few else KINDS)[kind]
    assert [c.name for c in found] == list(names) and {c.rows for c in found} == {CHECKED}
    assert sum(c.differ for c in found) == 0
    table = (PAGES / "tables" / "firmware_laws.md").read_text(encoding="utf-8")
    compiler = TARGETS[target].prefix + TARGETS[target].compiler
    version = cc(PAGES, "--version", compiler=compiler).stdout.splitlines()[0]
    if kind == "plain" and flags is None and version in table:
        rows = [[cell.strip() for cell in line.split("|")] for line in table.splitlines()]
        at = next(k for k, head in enumerate(rows[0]) if f"{target} {real}, {style}" in head)
        kept = {row[1]: row[at : at + 2] for row in rows[2:] if {*row[1:2]} & {*names}}
        counts = {c.name: c.instructions or (0, 0) for c in found}
        now = {c.name: ["{}…{}".format(*counts[c.name]), str(c.code)] for c in found}
        assert kept == now, "python docs/make_firmware_tables.py makes the table anew"
        if (target, style) == ("m4f", "unrolled"):
            alone = {row[1]: row[at + 2] for row in rows[2:] if len(row) > at}
            assert alone == {c.name: "{}…{}".format(*c.law_and_limits) for c in found}
            assert max(c.law_and_limits[1] for c in found) <= MOST


@pytest.mark.parametrize(
    ("target", "real", "flags"),
    [
        pytest.param("host", "float32", "-O3 -march=haswell", marks=FUSES),
        pytest.param("host", "float64", "-O3 -march=haswell", marks=FUSES),
        ("m4f", "float32", "-O2"),
    ],
)
def test_fused_multiply_add_is_found(tmp_path, capsys, target, real, flags):
    """The negative control: with it the bits differ, and the command says so by its exit code."""
    folder = str(exported(tmp_path, real, "unrolled", "vsg-1", "hybrid-angle"))
    command = ["firmware", "check", folder, "--target", target]
    assert main(command) == 0
    assert capsys.readouterr().out.endswith(
        f"\n{target}, {TARGETS[target].optimised}: no word differs\n"
    )
    assert main([*command, f"--flags={flags} -ffp-contract=fast"]) == 3
    told = capsys.readouterr()
    assert f"\n{target}, {flags} -ffp-contract=fast: words that differ: " in told.out
    assert "look for a fused multiply-add" in told.err


def test_a_folder_that_lacks_a_source_or_crashes_is_told(tmp_path):
    folder = exported(tmp_path, "float32", "unrolled", "vsg-1")
    source = folder / "gfm_vsg_1.c"
    text = source.read_text(encoding="utf-8")
    source.write_text(text.replace("s->channel = -1;", "__builtin_trap();"), encoding="utf-8")
    with pytest.raises(LawError, match="ended by SIG"):
        check(folder, "host")
    source.unlink()
    with pytest.raises(LawError, match=r"gfm_vsg_1\.c: is not there; gfmhil firmware export"):
        check(folder, "host")


@pytest.mark.parametrize("style", STYLES)
def test_a_change_of_gains_has_the_kernels_bits(tmp_path, style):
    laws = {"vsg-2": get_law("vsg-2"), "softer": get_law("vsg-2", D_p=0.02)}
    exported(tmp_path, "float32", style, of=laws)
    assert [c.differ for c in check(tmp_path, "host")] == [0, 0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize(
    ("real", "compiler"), [("float64", "gcc"), ("float32", "clang"), ("float64", "clang")]
)
def test_the_code_compiles_without_a_warning(folder, real, style, compiler, kind):
    """In float32 gcc compiles it for the sanitizers, with the same flags."""
    at = folder(kind, real, style, few=True)
    sources = sorted(p.name for p in at.glob("*.c"))
    done = cc(at, *STRICT, "-fsyntax-only", *sources, compiler=compiler)
    assert (done.returncode, done.stderr) == (0, "")


def test_no_rule_of_misra_is_broken_but_those_of_the_page(tmp_path):
    """By cppcheck's addon; and the page names no rule that is not broken."""
    page = (PAGES / "protection.md").read_text(encoding="utf-8")
    (macros,) = re.findall(r"-DFLT_.*?-D__GNUC__=12", page, re.DOTALL)
    check_it = ["--addon=misra", "--enable=style", "--std=c99", "--quiet", "-j2"]
    check_it += [flag for flag in macros.split() if flag.startswith("-D")]
    found: dict[str, str] = {}
    for style, real, of, names in (
        ("unrolled", "float32", LAWS, SOME[1:-1]),  # the others have no other statements
        ("unrolled", "float64", STAGED, FEW_STAGED),
        ("tunable", "float32", LAWS, SOME[:-1]),  # the last takes as long as all others
        ("records", "float64", LAWS, SOME[:1]),  # a law is a table there
        ("records", "float32", STAGED, FEW_STAGED[:1]),
        ("unrolled", FIXED, LAWS, SOME),
    ):
        folder = tmp_path / f"{style}-{real}"
        folder.mkdir()
        exported(folder, real, style, *names, of=of)
        folders = [folder]
        if of is LAWS and real != FIXED and style != "tunable":
            scheduled = ["mimo-gfm-scheduled", "--style", style, "--real", real]
            folders.append(folder / "scheduled")
            assert main(["firmware", "export", *scheduled, "-o", str(folders[-1])]) == 0
        for at in folders:
            files = sorted(p.name for p in at.glob("gfm*.c"))
            done = cc(at, *check_it, *files, compiler="cppcheck")
            assert done.returncode == 0 and "noValidConfiguration" not in done.stderr
            for line in done.stderr.splitlines():
                for rule in re.findall(r"\[misra-c2012-([\d.]+)\]$", line):
                    found.setdefault(rule, f"{at.relative_to(tmp_path)}/{line}")
    listed = set(re.findall(r"^\| ([\d.]+) \| (?:required|advisory) \|", page, re.MULTILINE))
    assert len(found) > 5
    assert [place for rule, place in found.items() if rule not in listed] == []
    assert listed - found.keys() == set()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("style", STYLES)
def test_sanitizers_find_nothing_and_the_self_test_passes(folder, style, kind, tmp_path):
    at, program = folder(kind, "float32", style, few=True), str(tmp_path / "selftest")
    done = cc(
        at, *STRICT, "-O1", "-fsanitize=undefined,address,float-divide-by-zero",
        "-fno-sanitize-recover=all", *sorted(p.name for p in at.glob("*.c")), "-o", program, "-lm",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ran = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout == f"{210 * len(FEW[kind])} rows, 0 words differ\n"


@pytest.mark.parametrize("real", REALS)
def test_no_symbol_of_libm_but_sqrt(folder, real, tmp_path):
    plain, staged = (folder(kind, real, "unrolled", few=True) for kind in KINDS)
    sources = [plain / f"gfm_{law}.c" for law in ("vsg_1", "psc_dc", "dvoc", "hybrid_angle")]
    sources += [staged / "gfm_vsg_1_cascaded.c"]
    sources += [folder("staged", real, "records", few=True) / "gfm.c"]
    for flags in ("-O0", "-O2"):
        assert cc(tmp_path, *STRICT, flags, "-c", *map(str, sources)).returncode == 0
        objects = [p.name for p in tmp_path.glob("*.o")]
        said = cc(tmp_path, "-P", *objects, compiler="nm").stdout  # name, kind, place
        kinds: dict[str, set[str]] = {}
        for name, kind in (line.split()[:2] for line in said.splitlines() if " " in line):
            kinds.setdefault(kind, set()).add(name)
        root = "sqrtf" if real == "float32" else "sqrt"
        assert root in kinds["U"]
        assert kinds["U"] <= {root, "memset", "memcpy", "_GLOBAL_OFFSET_TABLE_"}
        assert set(kinds) <= set("URTtr"), "code and constants, no variables"


@pytest.mark.parametrize(
    ("flag", "why"),
    [("-ffast-math", "-ffast-math changes"), ("-mfpmath=387", "rounded to their own type")],
)
def test_what_would_change_bits_does_not_compile(folder, flag, why):
    at = folder("plain", "float32", "unrolled", few=True)
    done = cc(at, "-std=c99", flag, "-fsyntax-only", "gfm_vsg_1.c")
    assert done.returncode != 0 and why in done.stderr


def test_the_pages_examples_compile(tmp_path):
    page = (PAGES / "firmware.md").read_text(encoding="utf-8")
    plain, tuned, in_integers, with_stage, to_pins = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    exported(tmp_path, FIXED, "unrolled", "vsg-1")
    (tmp_path / "integers.txt").write_text(in_integers)
    done = cc(tmp_path, *STRICT, "-fsyntax-only", "-x", "c", "integers.txt")
    assert (done.returncode, done.stderr) == (0, "")
    exported(tmp_path, "float32", "tunable", "vsg-2")
    around = '#include "gfm_vsg_2.h"\nvoid report(void);\nvoid change(gfm_vsg_2_t *);\n'
    around += f"void change(gfm_vsg_2_t *instance)\n{{\n{tuned.replace('&law', 'instance')}}}\n"
    (tmp_path / "tuned.txt").write_text(around)
    done = cc(tmp_path, *STRICT, "-fsyntax-only", "-x", "c", "tuned.txt")
    assert (done.returncode, done.stderr) == (0, "")
    exported(tmp_path, "float32", "unrolled", "vsg-1")
    called = "#include <stdint.h>\nvoid block_the_bridge(void);\nvoid report(int channel);\n"
    called += "void set_compare(uint16_t a, uint16_t b, uint16_t c, uint16_t enable);\n"
    for code, *chosen in ((plain,), (with_stage, "cascaded"), (to_pins, "cascaded", "rig")):
        if chosen:
            law = load_law("vsg-2", *chosen).laws[0]
            exported(tmp_path, "float32", "unrolled", of={"vsg-2": law})
        (tmp_path / "example.txt").write_text(called + code)
        done = cc(tmp_path, *STRICT, "-fsyntax-only", "-x", "c", "example.txt")
        assert (done.returncode, done.stderr) == (0, "")


# --- instances, driven from here ---


class Instance:
    """An instance of vsg-1 in float64, in memory that only this object holds."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._of, self._memory = library, np.full(64, np.nan)  # init must set all it uses
        self._call("init")

    def _call(self, name: str, *arrays: Any) -> int:
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (self._memory, *arrays)]
        return int(getattr(self._of, f"gfm_vsg_1_{name}")(*pointers))

    def step(self, ref: Any, y: Any, u: Any) -> int:
        return self._call("step", ref, y, u)

    def settle(self, ref: Any, y: Any, u: Any, trend: Any) -> int:
        return self._call("settle", ref, y, u, trend)

    def reset(self) -> None:
        self._call("reset")

    @property
    def x(self) -> Any:
        return self._memory[:3]


@pytest.fixture(scope="module")
def library(folder: Folder, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    at = tmp_path_factory.mktemp("library") / "vsg_1.so"
    arguments = [*STRICT, "-O2", "-shared", "-fPIC", "gfm_vsg_1.c", "-o", str(at)]
    assert cc(folder("plain", "float64", "unrolled", few=True), *arguments).returncode == 0
    return ctypes.CDLL(str(at))


def test_two_instances_do_not_see_each_other(library):
    """Interleaved, each gives what the kernel gives alone."""
    record = make_modules({"vsg-1": LAWS["vsg-1"]}, T_S, "float64")[0].record
    states = np.zeros(2, state_dtype())
    states["u"] = [0.0, 1.0, 1.0]
    both = [Instance(library), Instance(library)]
    inputs = [wander(300, seed=seed) for seed in (1, 2)]
    u, expected = np.zeros(3), np.zeros(3)
    for k in range(300):
        for instance, state, (refs, ys) in zip(both, states, inputs, strict=True):
            assert instance.step(refs[k], ys[k], u) == OK
            step(record, state, refs[k], ys[k], expected)
            np.testing.assert_array_equal(u, expected)


def test_the_safe_state_holds_until_a_reset(library):
    vsg, u, good = Instance(library), np.zeros(3), np.zeros(3)
    assert vsg.step(REF, REF, good) == OK
    u[:] = good
    bad = REF.copy()
    bad[1] = np.nan
    assert vsg.step(REF, bad, u) == BAD_Y
    assert vsg.step(REF, REF, u) == BAD_Y, "latched"
    assert vsg.settle(REF, REF, u, np.zeros(3)) == BAD_Y
    np.testing.assert_array_equal(u, good)
    vsg.reset()
    assert vsg.settle(REF, REF, u, np.zeros(3)) == OK
    assert vsg.step(REF, REF, u) == OK
    np.testing.assert_allclose(u, good, rtol=0, atol=1e-14)


def test_a_state_that_is_not_finite_is_found(library):
    vsg, u = Instance(library), np.array([7.0, 8.0, 9.0])
    vsg.x[0] = np.nan
    assert vsg.step(REF, REF, u) == BAD_U
    assert u.tolist() == [7.0, 8.0, 9.0]


def test_the_way_out_of_a_bad_u_leads_to_the_last_good_u(library):
    """A NaN in the state is neither in u nor in the trend that the way out begins with."""
    vsg, u, zero = Instance(library), np.zeros(3), np.zeros(3)
    assert vsg.step(REF, REF, u) == OK
    good = u.copy()
    vsg.x[0] = np.nan
    assert vsg.step(REF, REF, u) == BAD_U
    last = vsg._memory[6:9].copy()  # x, offset, u
    np.testing.assert_array_equal(last, good)
    vsg.reset()
    assert vsg.settle(REF, REF, last, zero) == OK
    assert vsg.step(REF, REF, u) == OK
    np.testing.assert_allclose(u, good, rtol=0, atol=1e-14)


def test_settle_and_switch_refuse_what_is_not_finite(library):
    vsg, u, bump = Instance(library), np.zeros(3), np.zeros(1)
    assert vsg.step(REF, REF, u) == OK
    before, zero = vsg._memory.copy(), np.zeros(3)
    for bad in (np.nan, np.inf):
        for k in range(3):
            wrong = np.where(np.arange(3) == k, bad, [0.0, 1.0, 1.0])
            assert vsg.settle(REF, REF, wrong.copy(), zero) == BAD_U
            assert vsg.settle(REF, REF, u.copy(), wrong) == BAD_U
            assert vsg._call("switch", REF, REF, wrong.copy(), zero, bump) == BAD_U
    np.testing.assert_array_equal(vsg._memory, before)


@pytest.mark.parametrize("laws", [LAWS, STAGED], ids=["plain", "staged"])
def test_golden_rows_reach_a_bad_u_and_the_way_out(laws):
    made = golden(make_modules(dict(list(laws.items())[:3]), T_S, "float64"), 210)
    at = {name: made.columns.index(name) for name in made.columns}
    result, op = made.words[:, at["result"]], made.words[:, at["op"]]
    (reset,) = np.nonzero(op == 3)
    bad = np.flatnonzero(result == BAD_U)
    assert set(made.words[bad, at["law"]]) == {0, 1, 2}
    after = reset[result[reset - 1] == BAD_U]
    assert len(after) >= 3 and (result[after] == OK).all()
    kept = [k for name, k in at.items() if name.startswith(("last_", "e_"))]
    assert np.isfinite(made.words[bad][:, kept].view(np.float64)).all()
