"""Firmware without a compiler: the text, the golden rows, the report, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gfm_hil.cli import main
from gfm_runtime import Law, LawError, LawSet, get_law
from gfm_runtime.assembly import Controller
from gfm_runtime.controller import control
from gfm_runtime.firmware import REALS, SHIPPED, STYLES, check, export, golden, make_modules
from gfm_runtime.firmware.c_text import literal, plain
from gfm_runtime.firmware.golden import INIT, RESET, SWITCH
from gfm_runtime.firmware.module import BAD_REF, INTEGERS, NUMBERS
from gfm_runtime.firmware.report import read_report
from gfm_runtime.inner import Inner
from gfm_runtime.signals import NU, NY, group
from gfm_runtime.states import OK, RUNNING, SAFE
from gfm_runtime.switchover import settle_into

from ..support.laws import LAWS, repeatable

T_S = 1e-4
#: one of each error map, one without states, the most states
SOME = ("vsg-1", "psc-dc", "dvoc", "hybrid-angle", "matching-2", "vsg-12")


def of(*names: str) -> dict[str, Law]:
    return {name: LAWS[name] for name in names}


def columns(rows: Any, real: str, *prefixes: str) -> list[Any]:
    """Blocks of the columns whose names begin with a prefix, as numbers."""
    return [
        rows.words[:, [c.startswith(f"{p}_") for c in rows.columns]].view(real) for p in prefixes
    ]


# --- golden rows ---


@pytest.mark.full
@pytest.mark.parametrize("name", LAWS)
def test_golden_rows_are_what_the_controller_does(name: str) -> None:
    """Rows in float64 against ``control``, the tick of the bench: u, states, refusals, changes."""
    modules = make_modules(of(name), T_S, "float64")
    rows = golden(modules, 2 * SHIPPED)
    refs, ys, us, xs, trends = columns(rows, "f8", "ref", "y", "u", "x", "trend")
    twins = [LawSet(n, (LAWS[name],)) for n in ("one", "other")]
    bench = Controller(twins, T_S, refs[0])
    bench.start(np.zeros(modules[0].n), np.array([s.default for s in group("u")]))
    u = np.zeros(NU)
    for k, (op, _, result) in enumerate(rows.words[:, :3]):
        assert (k == 0) == (op == INIT)
        if result == BAD_REF and bench.ctl["state"][0] == RUNNING:
            bench.ctl["state"] = SAFE  # the scenario's task on the bench
        bench.ctl["ref"] = bench.ctl["ref_target"] = refs[k]
        if op == SWITCH:
            bench.select("other" if bench.active == "one" else "one")
        if op == RESET:
            i = int(bench.ctl["active"][0])
            u[:] = bench.states[i]["u"]
            settle_into(bench.laws[i], bench.states[i], refs[k], ys[k], u, np.zeros(NU))
            bench.reset()
            bench.ctl["state"] = RUNNING
        control(bench.ctl, bench.laws, bench.states, bench.est, ys[k], u)
        state = bench.states[int(bench.ctl["active"][0])]
        assert (bench.ctl["state"][0] == RUNNING) == (result == OK)
        np.testing.assert_array_equal(us[k], u)
        np.testing.assert_array_equal(xs[k], state["x"][: xs.shape[1]])
        np.testing.assert_array_equal(trends[k], state["trend"])


@pytest.mark.full
@pytest.mark.parametrize("real", REALS)
def test_golden_rows_reach_all_paths(real: str) -> None:
    modules = make_modules(of("mimo-gfm", "vsg-1"), T_S, real)
    rows = golden(modules, 10_080)
    refs, ys, us, offsets = columns(rows, real, "ref", "y", "u", "offset")
    limits = LAWS["vsg-1"].limits
    for j in range(NU):
        assert {limits.low[j], limits.high[j]} <= set(us[:, j].astype(float).round(6))
    tiny = np.finfo(real).tiny
    assert np.sum((ys != 0) & (np.abs(ys) < tiny)) > 1000 and np.isnan(ys).any()
    assert np.isinf(ys).any() and offsets.any()
    ops, law, result = rows.words[:, :3].T
    assert {*ops} == {0, INIT, SWITCH, RESET} and {*result} == {OK, 1, BAD_REF}
    assert sum((np.diff(law.astype(int)) != 0) & (ops[1:] == SWITCH)) == 1, (
        "a change to another law"
    )
    bumps = rows.words[:, rows.columns.index("bump")].view(real)
    assert bumps.max() < 1e3 * np.finfo(real).eps
    again = 1 + np.flatnonzero((result[1:] != OK) & (result[:-1] != OK))
    np.testing.assert_array_equal(us[again], us[again - 1])  # held in the safe state
    ramps = np.diff(refs[30:60, 1].astype(float))
    assert np.ptp(ramps) < 1e-6 < abs(ramps[0])


def test_golden_rows_of_a_law_do_not_depend_on_their_number() -> None:
    modules = make_modules(of("dvoc"), T_S, "float32")
    few, many = golden(modules, SHIPPED), golden(modules, 2 * SHIPPED)
    np.testing.assert_array_equal(few.words, many.words[:SHIPPED])


# --- text ---


@repeatable
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_literal_is_its_number_to_the_bit(value: float) -> None:
    for real in (np.float64, np.float32):
        with np.errstate(over="ignore"):
            rounded = real(value)
        if np.isfinite(rounded):
            text = literal(value, np.dtype(real))
            assert text.endswith("f") == (real is np.float32)
            found = real(float.fromhex(text.rstrip("f") if real is np.float32 else text))
            assert found.tobytes() == rounded.tobytes()


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("real", REALS)
def test_the_code_calls_and_keeps_nothing_of_its_own(real: str, style: Any) -> None:
    """No libm but sqrt and fabs, no malloc, no variable outside of a function."""
    files = export(of(*SOME), T_S, real, style)
    end = "f" if real == "float32" else ""
    for name, text in files.items():
        if not (name.startswith("gfm") and name.endswith(".c")):
            continue
        code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        own = set(re.findall(r"^(?:static |IN_PLACE )?\w+ (\w+)\(", code, re.MULTILINE))
        called = set(re.findall(r"\b(\w+)\(", code)) - own
        language = {"if", "for", "switch", "sizeof", "__attribute__"}
        assert called <= {*language, f"sqrt{end}", f"fabs{end}"}, name
        for line in code.splitlines():
            if re.match(r"\s*(static|extern)\b", line) and "(" not in line:
                assert "const" in line, line
        numbers = re.findall(r"\b\d+\.\d+|0x[\w.]+p[-+]\d+\w*", code)
        assert all(n.endswith("f") == (real == "float32") for n in numbers)


def test_the_header_is_the_signal_table() -> None:
    text = export(of("vsg-1"), T_S, "float32", "unrolled")["gfm_vsg_1.h"]
    for letter, vector in (("REF", "ref"), ("Y", "y"), ("U", "u")):
        found = re.findall(rf"^    GFM_VSG_1_{letter}_(\w+),", text, re.MULTILINE)
        assert found == [s.name.upper() for s in group(vector)]  # type: ignore[arg-type]
    for s in (*group("ref"), *group("y"), *group("u")):
        assert f"{s.description}, {s.unit} of {s.base}, {s.low:g} to {s.high:g}" in text
    assert "D_p = 0.01 p.u. (Table III)" in text


@pytest.mark.parametrize("style", STYLES)
def test_the_same_law_gives_the_same_bytes(style: Any) -> None:
    assert export(of(*SOME), T_S, "float32", style) == export(of(*SOME), T_S, "float32", style)


def test_a_set_point_of_minus_zero_keeps_its_zeros() -> None:
    """Then a row's sum may be -0, and a term of +0 would make it +0."""
    law = replace(LAWS["droop-1"], u_0=(-0.0, 1.0, 1.0))
    text = export({"x": law}, T_S, "float64", "unrolled")["gfm_x.c"]
    row = re.search(r"t->raw\[0\] = ([^;]*);", text)
    assert row is not None and row[1].count("->") == 1 + 1 + 2 * NY + NY - 1


def test_a_remark_cannot_end_its_comment() -> None:
    assert plain("a */ b /* c\n d ??/ é\\") == "a * / b / * c d ? ?/ e"
    law = replace(LAWS["vsg-1"], title="*/ int x; /*", source="line\\\nline")
    text = export({"x": law}, T_S, "float32", "unrolled")["gfm_x.h"]
    assert "int x" not in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)


# --- report ---


@pytest.mark.parametrize("real", REALS)
def test_the_report_gives_the_records_back(real: str, tmp_path: Path) -> None:
    files = export(of(*SOME), T_S, real, "records")
    (tmp_path / "report.json").write_text(files["report.json"], encoding="utf-8")
    found = read_report(tmp_path)
    assert (found.real, found.style) == (real, "records")
    for module, name in zip(found.modules, SOME, strict=True):
        assert module.name == name
        record = make_modules(of(name), T_S, real)[0].record
        for field in (*INTEGERS, *NUMBERS):
            assert module.record[field].tobytes() == record[field].tobytes()


def test_the_report_counts_the_operations_as_by_hand() -> None:
    """matching-2: i_u = P_ref, omega_u = 1 + m v, E_u = V_ref + k v with v = v_dc - V_dcref."""
    text = export(of("matching-2"), T_S, "float32", "unrolled")["report.json"]
    found = json.loads(text)["laws"][0]
    assert found["operations"] == {
        "multiplications": 0 + 2 + 2 + 3 + 3,  # rows of u, offsets, trends
        "additions": 2 + 3 + 4 + 3 * 3 + 5,  # rows of u with their offset, trends, is u finite
        "divisions": 0,
        "square_roots": 0,
        "comparisons": 3 * 2 + 6 + 10 + 6 + 1,  # limits, what fades, inputs (6 not symmetric), u
    }
    assert found["bytes"]["state"] == 4 * (1 + 3 + 3 + 3)


# --- refusals ---


def test_two_laws_with_one_name_in_c_are_refused() -> None:
    with pytest.raises(LawError, match=r"'VSG 1'.*'vsg-1' has the same name in C"):
        make_modules({"vsg-1": LAWS["vsg-1"], "VSG 1": LAWS["vsg-1"]}, T_S, "float32")
    with pytest.raises(LawError, match="no letter or digit"):
        make_modules({"Φ": LAWS["vsg-1"]}, T_S, "float32")


def test_limits_that_are_not_finite_are_refused() -> None:
    endless = replace(LAWS["vsg-1"].limits, high=(np.inf, 1.1, 1.5))
    with pytest.raises(LawError, match=r"'x'.*high must be finite"):
        make_modules({"x": replace(LAWS["vsg-1"], limits=endless)}, T_S, "float32")


@pytest.mark.parametrize(
    ("key", "value", "why"),
    [("n", 13, "13 states"), ("n", -1, "-1 states"), ("error_map", 7, "error map 7"),
     ("A", "nan", "is not as"), ("loop", "inf", "loop must be finite"),
     ("decay", "0x1p+9999", "is not as")],
)  # fmt: skip
def test_a_record_that_the_kernel_cannot_hold_is_refused(
    key: str, value: Any, why: str, tmp_path: Path
) -> None:
    whole = json.loads(export(of("vsg-1"), T_S, "float32", "unrolled")["report.json"])
    whole["laws"][0]["record"][key] = value
    (tmp_path / "report.json").write_text(json.dumps(whole), encoding="utf-8")
    with pytest.raises(LawError, match=why):
        read_report(tmp_path)


def test_an_inner_stage_is_refused() -> None:
    with pytest.raises(LawError, match=r"'x'.*inner stage"):
        make_modules({"x": replace(LAWS["vsg-1"], inner=Inner("cascaded"))}, T_S, "float32")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "is not there; gfmhil firmware export writes it"),
        ("{", "is not JSON"),
        ('{"format": 9}', "format: 9 must be 1"),
        ('{"format": 1, "real": "int8"}', "real: 'int8' must be float32 or float64"),
        ('{"format": 1, "real": "float32", "style": "records", "laws": []}', "laws: there must"),
        ('{"format": 1, "real": "float32", "style": "records", "laws": [{}]}', "is not as"),
        ("[]", "is not as gfmhil firmware export writes it"),
    ],
)
def test_a_folder_that_is_none_is_refused(
    text: str | None, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (tmp_path / "report.json").write_text(text, encoding="utf-8")
    assert main(["firmware", "check", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f"gfmhil: {tmp_path / 'report.json'}: {why}")


@pytest.mark.parametrize(
    ("target", "package"),
    [
        ("host", "gcc"), ("clang", "clang"), ("m4f", "gcc-arm-none-eabi"),
        ("m7", "qemu-system-arm"), ("rv64", "qemu-system-misc"),
    ],
)  # fmt: skip
def test_a_missing_toolchain_is_named(
    target: str,
    package: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["firmware", "export", "droop-1", "-o", str(tmp_path)]) == 0
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["firmware", "check", str(tmp_path), "--target", target]) == 2
    said = capsys.readouterr().err
    assert "apt-get install" in said and package in said and said.count("\n") == 1


def test_the_command_writes_what_the_function_gives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [
        "firmware",
        "export",
        "mimo-gfm-scheduled",
        "--real",
        "float64",
        "-o",
        str(tmp_path),
    ]
    assert main(arguments) == 0
    stages = of("mimo-gfm-scheduled[0]", "mimo-gfm-scheduled[1]")
    for name, text in export(stages, T_S, "float64", "unrolled").items():
        assert (tmp_path / name).read_text(encoding="utf-8") == text
    capsys.readouterr()
    assert main(["firmware", "golden", "vsg-1", "--ticks", "7"]) == 0
    rows = golden(make_modules({"vsg-1": get_law("vsg-1")}, T_S, "float32"), 7)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == ",".join(rows.columns)
    assert [[int(w, 16) for w in line.split(",")] for line in lines[1:]] == rows.words.tolist()


def test_what_the_command_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, why in (
        (["golden", "vsg-1", "--ticks", "0"], "--ticks 0: must be at least 1"),
        (["export", "vsg-1", "vsg-1", "-o", str(tmp_path)], "law 'vsg-1': is named twice"),
        (["export", "vsg", "-o", str(tmp_path)], "law 'vsg': unknown"),
        (["export", "vsg-1", "--T_s", "0", "-o", str(tmp_path)], "T_s: 0.0 s must be > 0"),
    ):
        assert main(["firmware", *arguments]) == 2
        assert why in capsys.readouterr().err
    with pytest.raises(LawError, match="is not there"):
        check(tmp_path, "host")
