"""Firmware compiled: every bit of every law on this machine and on processors in QEMU."""

import ctypes
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gfm_hil.cli import main
from gfm_runtime import LawError, get_law, load_law
from gfm_runtime.firmware import CHECKED, FIXED, REALS, STYLES, check, golden, make_modules
from gfm_runtime.kernel import state_dtype, step
from gfm_runtime.states import BAD_U, BAD_Y, OK

from ..support import firmware
from ..support.firmware import SOME, STAGED, T_S, cc, exported
from ..support.laws import LAWS, REF, wander

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]

PAGES = Path(__file__).parents[2] / "docs"
FUSES = pytest.mark.skipif(
    " fma " not in Path("/proc/cpuinfo").read_text(), reason="the processor has no FMA"
)
STRICT = [*firmware.STRICT, "-Wdouble-promotion", "-ffp-contract=off"]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Path]:
    """A folder with all laws for each precision and style."""
    return {
        (real, style): exported(tmp_path_factory.mktemp(f"{style}-{real}"), real, style)
        for real in REALS
        for style in STYLES
    }


@pytest.fixture(scope="module")
def staged(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Path]:
    """A folder with laws with inner stages for each precision and style."""
    return {
        (real, style): exported(
            tmp_path_factory.mktemp(f"staged-{style}-{real}"), real, style, of=STAGED
        )
        for real in REALS
        for style in STYLES
    }


def differing(folder: Path, target: str, flags: str, of: Any = LAWS) -> int:
    """Words that differ over all laws; each law must have gone through all its rows."""
    found = check(folder, target, flags)
    assert [c.name for c in found] == list(of) and {c.rows for c in found} == {CHECKED}
    return sum(c.differ for c in found)


@pytest.mark.parametrize("real", REALS)
@pytest.mark.parametrize(
    ("target", "style", "flags"),
    [
        *[("host", "unrolled", f"-O{level}") for level in (0, 2, 3)],
        ("host", "records", "-O2"),
        ("clang", "unrolled", "-O2"),
    ],
)
def test_every_law_has_the_kernels_bits(folders, real, target, style, flags):
    assert differing(folders[real, style], target, flags) == 0


@pytest.mark.parametrize(
    ("target", "real", "style", "flags"),
    [
        ("host", "float32", "unrolled", "-O2"), ("host", "float64", "records", "-O3"),
        ("clang", "float64", "unrolled", "-O2"),
    ],
)  # fmt: skip
def test_every_stage_has_the_kernels_bits(staged, real, target, style, flags):
    assert differing(staged[real, style], target, flags, STAGED) == 0


@pytest.mark.parametrize(
    ("target", "real", "flags"),
    [
        pytest.param("host", "float32", "-O3 -march=haswell", marks=FUSES),
        pytest.param("host", "float64", "-O3 -march=haswell", marks=FUSES),
    ],
)
def test_fused_multiply_add_is_found(tmp_path, capsys, target, real, flags):
    """The negative control: with it the bits differ, and the command says so by its exit code."""
    folder = str(exported(tmp_path, real, "unrolled", "vsg-1", "hybrid-angle"))
    command = ["firmware", "check", folder, "--target", target]
    assert main(command) == 0
    assert main([*command, f"--flags={flags} -ffp-contract=fast"]) == 3
    assert "look for a fused multiply-add" in capsys.readouterr().err


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


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("real", REALS)
def test_the_code_compiles_without_a_warning(folders, staged, real, style, compiler):
    for folder in (folders[real, style], staged[real, style]):
        sources = sorted(p.name for p in folder.glob("*.c"))
        done = cc(folder, *STRICT, "-fsyntax-only", *sources, compiler=compiler)
        assert (done.returncode, done.stderr) == (0, "")


def test_no_rule_of_misra_is_broken_but_those_of_the_page(tmp_path):
    """By cppcheck's addon; and the page names no rule that is not broken."""
    page = (PAGES / "protection.md").read_text(encoding="utf-8")
    (macros,) = re.findall(r"-DFLT_.*?-D__GNUC__=12", page, re.DOTALL)
    check_it = ["--addon=misra", "--enable=style", "--std=c99", "--quiet", "-j2"]
    check_it += [flag for flag in macros.split() if flag.startswith("-D")]
    staged = {name: law for name, law in STAGED.items() if name.startswith(("vsg-2", "threshold"))}
    found: dict[str, str] = {}
    for style, real, laws in (
        ("unrolled", "float32", {name: LAWS[name] for name in SOME}),
        ("unrolled", "float64", staged),
        ("tunable", "float32", {name: LAWS[name] for name in SOME}),
        ("records", "float64", {name: LAWS[name] for name in SOME}),
        ("records", "float32", staged),
        ("unrolled", FIXED, {name: LAWS[name] for name in SOME}),
    ):
        folder = tmp_path / f"{style}-{real}"
        folder.mkdir()
        exported(folder, real, style, of=laws)
        folders = [folder]
        if real != FIXED and style != "tunable":
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


@pytest.mark.parametrize(
    ("style", "laws"),
    [(style, laws) for style in STYLES for laws in (LAWS, STAGED)],
    ids=[f"{style}-{laws}" for style in STYLES for laws in ("plain", "staged")],
)
def test_sanitizers_find_nothing_and_the_self_test_passes(folders, staged, style, laws, tmp_path):
    folder = (folders if laws is LAWS else staged)["float32", style]
    program = str(tmp_path / "selftest")
    done = cc(
        folder, *STRICT, "-O1", "-fsanitize=undefined,address,float-divide-by-zero",
        "-fno-sanitize-recover=all", *sorted(p.name for p in folder.glob("*.c")),
        "-o", program, "-lm",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    ran = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout == f"{210 * len(laws)} rows, 0 words differ\n"


@pytest.mark.parametrize("real", REALS)
def test_no_symbol_of_libm_but_sqrt(folders, staged, real, tmp_path):
    folder = folders[real, "unrolled"]
    sources = [str(folder / f"gfm_{law}.c") for law in ("vsg_1", "psc_dc", "dvoc", "hybrid_angle")]
    sources += [str(staged[real, "unrolled"] / "gfm_vsg_2_cascaded.c")]
    sources += [str(staged[real, "records"] / "gfm.c")]
    for flags in ("-O0", "-O2"):
        assert cc(tmp_path, *STRICT, flags, "-c", *sources).returncode == 0
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
def test_what_would_change_bits_does_not_compile(folders, flag, why):
    done = cc(folders["float32", "unrolled"], "-std=c99", flag, "-fsyntax-only", "gfm_vsg_1.c")
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
def library(folders: Any, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    at = tmp_path_factory.mktemp("library") / "vsg_1.so"
    arguments = [*STRICT, "-O2", "-shared", "-fPIC", "gfm_vsg_1.c", "-o", str(at)]
    assert cc(folders["float64", "unrolled"], *arguments).returncode == 0
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
