"""Calibration files of firmware: what nm, another reader of DWARF and an A2L parser say of them."""

import os
import re
import shutil
import struct
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from gfm_hil.cli import main
from gfm_runtime.errors import LawError
from gfm_runtime.firmware import Entry, a2l_text, elf_entries

from ..support.files import text_of
from ..support.firmware import cc, exported

A2LTOOL = shutil.which("a2ltool", path=str(Path(sys.executable).parent)) or "a2ltool"
RECORDS = text_of("records.c")
UNROLLED = text_of("unrolled.c")
ARM = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "--specs=nosys.specs")
SETTINGS = pytest.mark.parametrize(
    ("compiler", "flags"),
    [("gcc", ()), ("clang", ("-gdwarf-5",)), ("arm-none-eabi-gcc", ARM)],
    ids=["gcc", "clang", "arm"],
)


def built(place: Path, compiler: str, flags: tuple[str, ...], main_c: str, style: str) -> Path:
    """A firmware of vsg-2, linked with debug information."""
    if style == "records":
        exported(place, "float32", style, "vsg-2")
    else:
        from ..support.firmware import STAGED

        exported(place, "float32", style, "vsg-2 cascaded", of=STAGED)
    (place / "main.c").write_text(main_c)
    sources = sorted(path.name for path in place.glob("gfm*.c"))
    done = cc(
        place, "-g", "-O1", *flags, "main.c", *sources, "-o", "program.elf", "-lm",
        compiler=compiler,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return place / "program.elf"


def source(place: Path) -> str:
    return (place / "gfm_vsg_2.c").read_text()


def addresses(text: str) -> dict[str, int]:
    """The address of every entry of an A2L file by its name."""
    found = re.findall(
        r"/begin (?:MEASUREMENT|CHARACTERISTIC) (\S+) .*?"
        r"(?:ECU_ADDRESS|VALUE|VAL_BLK) (0x[0-9a-fA-F]+)",
        text,
        re.DOTALL,
    )
    return {name: int(address, 16) for name, address in found}


def read_again(a2l: Path, elf: Path) -> str:
    """The file as a2ltool, which reads DWARF itself, writes it with the addresses that it finds."""
    again = a2l.with_suffix(".again.a2l")
    subprocess.run(
        [A2LTOOL, a2l, "--strict", "--check", "-e", elf, "--update", "ADDRESSES",
         "--update-mode", "STRICT", "-o", again],
        check=True, capture_output=True,
    )  # fmt: skip
    return again.read_text()


@SETTINGS
@pytest.mark.compilers
def test_a_record_in_ram_is_calibrated_where_the_symbols_are(tmp_path, compiler, flags):
    elf = built(tmp_path, compiler, flags, RECORDS, "records")
    a2l = tmp_path / "program.a2l"
    assert main(["firmware", "a2l", str(elf), "-o", str(a2l)]) == 0
    text = a2l.read_text()
    found = addresses(text)
    assert found == addresses(read_again(a2l, elf))
    symbols = {
        name: int(address, 16)
        for address, name in re.findall(r"^(\w+) \w (\w+)", cc(tmp_path, elf.name, compiler="nm")
                                        .stdout, re.MULTILINE)
    }  # fmt: skip
    for first, symbol in {
        "law.x": "law", "gains.n": "gains", "gfm_vsg_2_law.n": "gfm_vsg_2_law",
        "y.v_dc": "y", "ref.V_dcref": "ref", "u.i_u": "u",
    }.items():  # fmt: skip
        assert found[first] == symbols[symbol]
    assert found["u.E_u"] == symbols["u"] + 8 and found["law.offset.i_u"] == symbols["law"] + 12
    (told,) = re.findall(r'const char gfm_vsg_2_id\[\d+\] =\s+"(.*)"', source(tmp_path))
    assert told.startswith(f"gfmhil {version('gfmhil')}; vsg-2; ")
    assert told.endswith("; float32; T_s = 0.0001 s; f_n = 50 Hz")
    assert f'  EPK "{told}"' in text and f"ADDR_EPK {symbols['gfm_vsg_2_id']:#x}" in text
    at = re.search(rb"gfmhil [^\0]*", elf.read_bytes())
    assert at is not None and at[0].decode() == told
    assert "pair.laws[1].reason" in found and not any(n.startswith("other") for n in found)
    flash = text.partition("CHARACTERISTIC gfm_vsg_2_law.A ")[2].partition("/end")[0]
    ram = text.partition("CHARACTERISTIC gains.A ")[2].partition("/end")[0]
    assert "READ_ONLY" in flash and "READ_ONLY" not in ram and "MATRIX_DIM 3 3" in ram
    power = text.partition("MEASUREMENT y.p ")[2].partition("/end")[0]
    assert "FLOAT32_IEEE in_p_u_s_n 0 0 -6 6" in power and "active power" in power
    moved = a2l.with_name("moved.a2l")  # the check would see a wrong address
    moved.write_text(text.replace(f"{found['y.p']:#x}", "0x12"))
    assert addresses(read_again(moved, elf)) == found != addresses(moved.read_text())


@SETTINGS
@pytest.mark.compilers
def test_of_constants_in_the_code_only_variables_are_measured(tmp_path, compiler, flags, capsys):
    elf = built(tmp_path, compiler, flags, UNROLLED, "unrolled")
    a2l = tmp_path / "program.a2l"
    assert main(["firmware", "a2l", str(elf), "-o", str(a2l)]) == 0
    said = capsys.readouterr()
    assert ", 0 characteristics" in said.out and "--style records" in said.err
    found = addresses(a2l.read_text())
    assert found == addresses(read_again(a2l, elf))
    assert found["u.E_q"] == found["u.i_u"] + 12 and found["y.i_oq"] == found["y.v_dc"] + 40
    assert {"law.stage.pll", "law.limited", "law.trend.E_u"} <= set(found)


@pytest.mark.compilers
def test_what_has_no_addresses_or_no_law_is_refused(tmp_path):
    (tmp_path / "main.c").write_text("static int n; int main(void) { return n; }")
    assert cc(tmp_path, "-g", "-c", "main.c").returncode == 0
    with pytest.raises(LawError, match=r"main\.o: is not linked"):
        elf_entries(tmp_path / "main.o")
    assert cc(tmp_path, "-g", "main.c", "-o", "without").returncode == 0
    with pytest.raises(LawError, match="has no variable of an exported law"):
        elf_entries(tmp_path / "without")
    assert cc(tmp_path, "main.c", "-s", "-o", "stripped").returncode == 0
    with pytest.raises(LawError, match="has no debug information; compile and link with -g"):
        elf_entries(tmp_path / "stripped")


def test_what_is_no_elf_file_is_refused(tmp_path, refused):
    file = tmp_path / "law.elf"
    for content in (b"", b"not one", b"\x7fELF" + bytes(100)):
        file.write_bytes(content)
        line = refused("firmware", "a2l", str(file), "-o", str(tmp_path / "x.a2l"))
        assert line.startswith(f"gfmhil: {file}: is no readable ELF file")
    refused("firmware", "a2l", str(tmp_path / "none"), "-o", "x.a2l")


def test_without_pyelftools_the_command_names_the_extra(tmp_path, monkeypatch, refused):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    line = refused("firmware", "a2l", str(tmp_path / "x.elf"), "-o", str(tmp_path / "x.a2l"))
    assert "needs pyelftools: pip install 'gfmhil[calibration]'" in line


def test_text_of_any_entry_is_read_by_a_parser(tmp_path):
    entries = [
        Entry("a.b", 'has "quotes", a \\ and a ü', "FLOAT64_IEEE", 0x10, "p.u. (Z_b)", 0.0, 0.1),
        Entry("c[1]", "", "UBYTE", 0xFFFFFFFF, words=((0, ""), (3, "three"))),
        Entry("d", "", "SWORD", 0, shape=(2, 3), calibrated=True),
    ]
    file = tmp_path / "x.a2l"
    texts = [(0x40, 'one "law"'), (0x80, "another")]
    file.write_text(a2l_text("1 x", "about", entries, True, (), texts))
    assert 'VERSION "one \\"law\\" | another"' in file.read_text()
    subprocess.run([A2LTOOL, file, "--strict", "--check"], check=True, capture_output=True)
    assert "MSB_FIRST" in file.read_text()
    with pytest.raises(LawError, match="d: two variables have this name"):
        a2l_text("x", "", [entries[2], entries[2]])
    with pytest.raises(LawError, match="address 0x100000000 must have at most 32 bits"):
        a2l_text("x", "", [Entry("x", "", "UBYTE", 2**32)])


def test_a_damaged_file_that_points_beyond_any_file_is_refused(tmp_path):
    kind, where = b"\x7fELF\x02\x01\x01" + bytes(9), 64
    head = struct.pack("<HHIQQQIHHHHHH", 2, 62, 1, 0, 0, where, 0, 64, 0, 0, 64, 3, 2)
    sections = [(0, 0, 0, 0), (1, 1, 300, 9), (0, 3, 2**62, 20)]  # name, type, offset, size
    for name, of, offset, size in sections:
        head += struct.pack("<IIQQQQIIQQ", name, of, 0, 0, offset, size, 0, 0, 1, 0)
    file = tmp_path / "program.elf"
    file.write_bytes(kind + head + bytes(200))
    with pytest.raises(LawError, match=r"program.elf: is damaged: OSError"):
        elf_entries(file)


def test_a_pipe_is_no_program(tmp_path, refused):
    os.mkfifo(tmp_path / "pipe")
    line = refused("firmware", "a2l", str(tmp_path / "pipe"), "-o", str(tmp_path / "x.a2l"))
    assert line == f"gfmhil: {tmp_path / 'pipe'}: is not a regular file\n"
