"""The generated C header: its content, and that a compiler gives its structs the same layout."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from gfm_runtime.c_header import c_header, c_struct


def test_struct_of_a_record() -> None:
    dtype = np.dtype([("n", "i8"), ("gain", "f4"), ("A", "f8", (2, 3))], align=True)
    assert c_struct(dtype, "thing_t").splitlines() == [
        "typedef struct {",
        "    int64_t n;",
        "    float gain;",
        "    double A[2][3];",
        "} thing_t;",
        '_Static_assert(sizeof(thing_t) == 64, "thing_t");',
        '_Static_assert(offsetof(thing_t, n) == 0, "thing_t.n");',
        '_Static_assert(offsetof(thing_t, gain) == 8, "thing_t.gain");',
        '_Static_assert(offsetof(thing_t, A) == 16, "thing_t.A");',
    ]


@pytest.mark.parametrize("kind", ["i2", "S4", ">f8", "c16"])
def test_a_field_without_a_c_type_is_named(kind: str) -> None:
    with pytest.raises(ValueError, match=r"thing_t\.odd: "):
        c_struct(np.dtype([("n", "i8"), ("odd", kind)]), "thing_t")


def test_what_is_not_a_record_is_refused() -> None:
    with pytest.raises(ValueError, match="float64 is not a record"):
        c_struct(np.dtype("f8"), "thing_t")
    with pytest.raises(ValueError, match="float16: must be float64 or float32"):
        c_header("f2")


@pytest.mark.parametrize("real", ["float64", "float32"])
def test_the_inner_stage_is_in_the_header(real: str) -> None:
    """11 measurements and 4 commands; kinds and priorities under the numbers of the records."""
    lines = c_header(real).splitlines()
    wanted = {
        "NY_INNER": 11, "NU_INNER": 4, "INNER_NONE": 0, "INNER_VIRTUAL_STATOR": 1,
        "INNER_CASCADED": 2, "INNER_THRESHOLD_IMPEDANCE": 3, "PRIORITY_CIRCULAR": 0,
        "PRIORITY_D": 1, "PRIORITY_Q": 2, "PRIORITY_ANGLE": 3,
    }  # fmt: skip
    assert {f"#define {name} {number}" for name, number in wanted.items()} <= {*lines}
    assert "    int64_t priority;" in lines and "    int64_t limited;" in lines


@pytest.mark.apt
@pytest.mark.parametrize("real", ["float64", "float32"])
def test_a_compiler_agrees(real: str, tmp_path: Path) -> None:
    """The header asserts every size and offset statically."""
    (tmp_path / "law.h").write_text(c_header(real), encoding="utf-8")
    (tmp_path / "law.c").write_text('#include "law.h"\n', encoding="utf-8")
    command = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "law.c"]
    subprocess.run(command, cwd=tmp_path, check=True)


@pytest.mark.apt
def test_a_compiler_disagrees_with_another_layout(tmp_path: Path) -> None:
    packed = np.dtype([("gain", "f4"), ("n", "i8")])  # C would pad to 8 bytes
    text = "#include <stddef.h>\n#include <stdint.h>\n" + c_struct(packed, "thing_t")
    (tmp_path / "thing.c").write_text(text, encoding="utf-8")
    command = ["cc", "-std=c11", "-fsyntax-only", "thing.c"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "thing_t.n" in done.stderr
