"""Firmware on other processors in QEMU, what it refuses there, and counts that are kept."""

from pathlib import Path

import pytest

from gfm_hil.cli import main
from gfm_runtime import load_law
from gfm_runtime.firmware import TARGETS, check
from gfm_runtime.inner_file import inner_names

from ..support.firmware import MOST, STAGED, cc, exported

pytestmark = [pytest.mark.compilers, pytest.mark.timeout(900)]

PAGES = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(
    ("target", "real"),
    [("s390x", "float32"), ("s390x", "float64"), ("aarch64", "float64"), ("i386", "float32"),
     ("i386", "float64"), ("m3", "float32"), ("m3", "float64")],
)  # fmt: skip
def test_other_processors_have_the_kernels_bits(tmp_path, target, real):
    """Big-endian, 64 bits, 32 bits with SSE2, and floats in software."""
    exported(tmp_path, real, "unrolled", "vsg-1", "hybrid-angle", "dvoc")
    (tmp_path / "stage").mkdir()
    staged = {name: STAGED[name] for name in list(STAGED)[:2]}
    exported(tmp_path / "stage", real, "unrolled", of=staged)
    for folder in (tmp_path, tmp_path / "stage"):
        found = check(folder, target, ticks=2100)
        assert [c.differ for c in found] == [0] * len(found)


def test_a_scheduled_law_refuses_what_would_change_bits(tmp_path):
    command = ["firmware", "export", "mimo-gfm-scheduled", "-o", str(tmp_path)]
    assert main(command) == 0
    source = "gfm_mimo_gfm_scheduled.c"
    for flags, why in (
        (["-ffast-math"], "-ffast-math changes"),
        (["-mfpmath=387"], "rounded to their own type"),
        (["-D__DBL_MANT_DIG__=24"], "double is not the IEEE 754 type of 64 bits"),
    ):
        done = cc(tmp_path, "-std=c99", *flags, "-fsyntax-only", source)
        assert done.returncode != 0
        text = "\n".join(line for line in done.stderr.splitlines() if line.startswith(source))
        assert why in text
    done = cc(tmp_path, "-std=c99", "-fsyntax-only", source, compiler="s390x-linux-gnu-gcc")
    if done.returncode:  # its float is evaluated in double by default
        assert "-fexcess-precision=fast" in done.stderr and "-msse2" not in done.stderr


def test_the_table_of_stages_is_what_is_measured(tmp_path):
    compiler = TARGETS["m4f"].prefix + TARGETS["m4f"].compiler
    version = cc(PAGES, "--version", compiler=compiler).stdout.splitlines()[0]
    if version not in (PAGES / "tables" / "firmware_laws.md").read_text(encoding="utf-8"):
        pytest.skip(f"the tables are not of {version}")
    table = (PAGES / "tables" / "firmware_stages.md").read_text(encoding="utf-8")
    for stage in inner_names():
        exported(tmp_path, "float32", "unrolled", of={"vsg-2": load_law("vsg-2", stage).laws[0]})
        (one,) = check(tmp_path, "m4f")
        assert one.instructions is not None
        counted = "{}…{}".format(*one.instructions)
        sizes = one.code, one.constants, one.state, one.stack
        row = (stage, "m4f float32, unrolled", counted, *sizes)
        assert f"| {' | '.join(map(str, row))} |" in table, "make_firmware_tables.py makes it anew"


def test_instructions_are_the_same_in_every_run(tmp_path):
    folder = exported(tmp_path, "float32", "unrolled", "droop-1", "mimo-gfm")
    first, again = (check(folder, "m4f", ticks=210) for _ in range(2))
    assert first == again
    droop, mimo = (c.law_and_limits for c in first)
    assert 100 < droop[0] <= droop[1] < mimo[0] <= mimo[1] <= MOST
    # 10 inputs: each is loaded, compared with one or two constants, and branched on
    assert all(c.checks is not None and 60 <= c.checks <= 120 for c in first)
